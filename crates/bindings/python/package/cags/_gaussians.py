"""Gaussians, cameras, files of Gaussians, and the rasteriser."""

import os
from dataclasses import dataclass, field

import numpy as np

from . import _native
from ._points import threads_of

_SHAPES = {"means": "(n, 3)", "log_scales": "(n, 3)", "rotations": "(n, 4)", "opacity_logits": "(n,)", "sh": "(n, 1, 4, 9 or 16, 3)"}


@dataclass
class Gaussians:
    """Gaussians as 3DGS stores and learns them, all float32.

    Attributes
    ----------
    means : array of shape (n, 3)
        Centres in the world.
    log_scales : array of shape (n, 3)
        Natural logarithms of the standard deviations along the Gaussian's own axes.
    rotations : array of shape (n, 4)
        Quaternions w x y z; they need not be normalised.
    opacity_logits : array of shape (n,)
        Opacities before the sigmoid.
    sh : array of shape (n, 1, 4, 9 or 16, 3)
        Spherical harmonics of degree 0 to 3, the constant term first.
    antialias : bool, default=False
        Whether they were learnt with the 2D filter of Mip-Splatting, and are rendered so.
    shift : three floats, default=(0, 0, 0)
        What was subtracted from the centres of a scene far from the origin: ``means + shift`` in float64 are those of the world.

    Examples
    --------
    >>> import numpy as np, cags
    >>> one = cags.Gaussians(np.zeros((1, 3)), np.full((1, 3), -2.0), [[1, 0, 0, 0]], [3.0], np.ones((1, 1, 3)))
    >>> len(one), one.means.dtype
    (1, dtype('float32'))
    """

    means: np.ndarray
    log_scales: np.ndarray
    rotations: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    antialias: bool = False
    shift: tuple = (0.0, 0.0, 0.0)

    def __post_init__(self):
        for name in _SHAPES:
            found = np.asarray(getattr(self, name))
            if found.dtype.kind not in "fiub":
                raise ValueError(f"{name} holds {found.dtype}: expected numbers")
            setattr(self, name, np.ascontiguousarray(found, dtype=np.float32))
        self._checked()

    def _checked(self):
        """The same, in C order, if the arrays still fit each other: anybody may have put others in their place."""
        shift = tuple(float(v) for v in self.shift)
        if len(shift) != 3 or not np.isfinite(shift).all():
            raise ValueError(f"shift is {shift}: expected three finite numbers")
        self.shift = shift
        arrays = [getattr(self, name) for name in _SHAPES]
        for (name, shape), array in zip(_SHAPES.items(), arrays):
            if not isinstance(array, np.ndarray) or array.dtype != np.float32:
                raise ValueError(f"{name} holds {getattr(array, 'dtype', type(array).__name__)}: expected an array of float32")
            n = len(arrays[0]) if arrays[0].ndim else 0
            expected = {"means": (n, 3), "log_scales": (n, 3), "rotations": (n, 4), "opacity_logits": (n,)}.get(name)
            fits = array.shape == expected if expected else array.shape in [(n, k, 3) for k in (1, 4, 9, 16)]
            if not fits:
                raise ValueError(f"{name} has the shape {array.shape}: expected {shape}, n = {n}")
        if all(a.flags.c_contiguous for a in arrays):
            return self
        return Gaussians(*arrays, self.antialias, self.shift)

    def __len__(self):
        return len(self.means)

    def __getitem__(self, which):
        """Some of them: a slice, indices or a mask."""
        return Gaussians(*(np.atleast_1d(getattr(self, name)[which]) for name in _SHAPES), self.antialias, self.shift)


@dataclass
class Camera:
    """A pinhole camera: x right, y down, z forward; a pixel's centre lies at +0.5.

    Attributes
    ----------
    width, height : int
        Pixels.
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels.
    rotation : array of shape (3, 3)
        Of the pose: ``p_camera = rotation @ p_world + translation``.
    translation : array of shape (3,)
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self):
        self._native()

    def _native(self):
        """Its numbers, if they are still a camera's: anybody may have changed them. Sets what is given as lists as arrays."""
        try:
            self.rotation = np.asarray(self.rotation, dtype=np.float64)
            self.translation = np.asarray(self.translation, dtype=np.float64)
            numbers = [float(v) for v in (self.fx, self.fy, self.cx, self.cy)]
            width, height = (int(v) if v == v and v == v // 1 and abs(v) < 1 << 16 else 0 for v in (self.width, self.height))
        except TypeError as e:
            raise ValueError(f"a field of the camera is no number: {e}") from None
        if self.rotation.shape != (3, 3) or self.translation.shape != (3,):
            raise ValueError(
                f"rotation and translation have the shapes {self.rotation.shape} and {self.translation.shape}: expected (3, 3) and (3,)"
            )
        turns = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(self.rotation) > 0
        if not (turns and np.isfinite(self.translation).all()):
            raise ValueError("the pose is not a rotation and a translation of finite numbers")
        if not (numbers[0] > 0 and numbers[1] > 0 and np.isfinite(numbers).all()):
            raise ValueError(f"fx, fy, cx, cy are {self.fx}, {self.fy}, {self.cx}, {self.cy}: expected positive focal lengths")
        if not (1 <= width <= 1 << 15 and 1 <= height <= 1 << 15):
            raise ValueError(f"the picture has {self.width} x {self.height} pixels: expected 1 to 32768 along each side")
        return (width, height, *numbers, self.rotation.tolist(), self.translation.tolist())


@dataclass
class Rendered:
    """A picture.

    Attributes
    ----------
    rgb : float32 array of shape (height, width, 3)
        sRGB, 0 to 1 where harmonics do not go beyond.
    alpha : float32 array of shape (height, width)
        How much of the light is taken, 0 to 1.
    depth : float32 array of shape (height, width)
        Sum of blending weights times camera z: divided by ``alpha`` it is a depth.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


def _settings(background, near, n_jobs, gaussians):
    background = [float(v) for v in background]
    if len(background) != 3:
        raise ValueError(f"background has {len(background)} values: expected red, green, blue")
    if near is not None and not (near > 0 and np.isfinite(near)):
        raise ValueError(f"near is {near}: expected a distance above 0")
    return background, None if near is None else float(near), bool(gaussians.antialias), threads_of(n_jobs)


def render(gaussians, camera, *, background=(0, 0, 0), near=None, n_jobs=None):
    """Render a view.

    Exact: every Gaussian that adds 1/255 or more to a pixel, in the order of depth, as gsplat and the original 3DGS blend them.

    Parameters
    ----------
    gaussians : Gaussians
        Those with numbers that are not finite, and those behind the near plane, are not drawn.
    camera : Camera
    background : three floats, default=(0, 0, 0)
        Colour behind everything.
    near : float, default=None
        Nothing nearer is drawn, world units. None means 0.01, or a hundredth of a scene smaller than 1.
    n_jobs : int, default=None
        Threads; None and -1 mean one per core. The result does not depend on it.

    Returns
    -------
    Rendered

    Examples
    --------
    >>> import numpy as np, cags
    >>> one = cags.Gaussians([[0, 0, 2]], np.full((1, 3), -1.0), [[1, 0, 0, 0]], [9.0], np.ones((1, 1, 3)))
    >>> picture = cags.render(one, cags.Camera(8, 6, 10, 10, 4, 3))
    >>> picture.rgb.shape, bool(picture.alpha[3, 4] > 0.9)
    ((6, 8, 3), True)
    """
    return Rendered(*_native.render(gaussians._checked(), camera._native(), _settings(background, near, n_jobs, gaussians)))


def render_backward(gaussians, camera, d_rgb, d_alpha=None, d_depth=None, *, background=(0, 0, 0), near=None, n_jobs=None):
    """Differentiate :func:`render`: from the gradient of every pixel to that of every parameter.

    Parameters
    ----------
    gaussians, camera, background, near, n_jobs
        As for :func:`render`. The view is rendered again.
    d_rgb : array of shape (height, width, 3)
        d loss / d ``rgb``.
    d_alpha, d_depth : arrays of shape (height, width), default=None
        d loss / d ``alpha`` and ``depth``; None means 0.

    Returns
    -------
    Gaussians
        d loss / d each of its arrays.

    Examples
    --------
    >>> import numpy as np, cags
    >>> one = cags.Gaussians([[0, 0, 2]], np.full((1, 3), -1.0), [[1, 0, 0, 0]], [0.0], np.ones((1, 1, 3)))
    >>> gradient = cags.render_backward(one, cags.Camera(8, 6, 10, 10, 4, 3), np.ones((6, 8, 3)))
    >>> bool(gradient.opacity_logits[0] > 0)
    True
    """
    view = camera._native()
    size = (view[1], view[0])
    given = {"d_rgb": (d_rgb, (*size, 3)), "d_alpha": (d_alpha, size), "d_depth": (d_depth, size)}
    arrays = []
    for name, (array, shape) in given.items():
        if array is not None:
            array = np.ascontiguousarray(array, dtype=np.float32)
            if array.shape != shape:
                raise ValueError(f"{name} has the shape {array.shape}: expected {shape}")
        arrays.append(array)
    settings = _settings(background, near, n_jobs, gaussians)
    return Gaussians(*_native.render_backward(gaussians._checked(), view, *arrays, settings), gaussians.antialias)


def read_ply(path):
    """Read a file of Gaussians: PLY of any order of properties; also compressed PLY, SPZ, SOG, .splat, glTF by what the file holds.

    Parameters
    ----------
    path : path

    Returns
    -------
    Gaussians
        In the file's order, every number as it stands there.

    Raises
    ------
    FileNotFoundError
    ValueError
        When the file is damaged or of another kind; it says where.
    """
    if not os.path.exists(path):
        raise FileNotFoundError(2, "no such file", os.fspath(path))
    arrays, antialias, shift = _native.read_gaussians(path)
    return Gaussians(*arrays, antialias, shift)


def write_ply(path, gaussians, *, instance=None):
    """Write a file of Gaussians, whole or not at all; by its ending also .compressed.ply, .spz, .sog, .splat or .glb.

    Parameters
    ----------
    path : path
        An older file of this name is replaced.
    gaussians : Gaussians
    instance : int array of shape (n,), default=None
        The instance of each, -1 for none: a property of PLYs, refused by other formats.

    Examples
    --------
    >>> import numpy as np, cags, os, tempfile
    >>> one = cags.Gaussians([[0, 0, 2]], np.full((1, 3), -1.0), [[1, 0, 0, 0]], [0.0], np.ones((1, 1, 3)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = os.path.join(folder, "one.ply")
    ...     cags.write_ply(path, one)
    ...     bool((cags.read_ply(path).means == one.means).all())
    True
    """
    gaussians = gaussians._checked()
    if instance is not None:
        instance = np.ascontiguousarray(instance, dtype=np.int32)
        if instance.shape != (len(gaussians),):
            raise ValueError(f"instance has the shape {instance.shape}: expected ({len(gaussians)},)")
    _native.write_gaussians(path, gaussians, bool(gaussians.antialias), instance)
