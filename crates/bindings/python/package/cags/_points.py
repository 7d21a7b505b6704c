"""Points in space."""

import numbers
import os

import numpy as np

from . import _native


def threads_of(n_jobs):
    """The number of threads of scikit-learn's ``n_jobs``; 0 stands for one per core."""
    if n_jobs is None:
        return 0
    if not isinstance(n_jobs, numbers.Integral) or n_jobs == 0:
        raise ValueError(f"n_jobs is {n_jobs!r}: expected a number of threads, or None or -1 for one per core")
    return int(n_jobs) if n_jobs > 0 else max(1, (os.cpu_count() or 1) + 1 + int(n_jobs))


def cloud(points):
    """Points as the Rust half takes them: [n, 3], float32, one after the other."""
    points = np.ascontiguousarray(points, dtype=np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have the shape {points.shape}: expected (n, 3)")
    return points


def farthest_point_sample(points, count, *, start=0, n_jobs=None):
    """Choose points that are spread evenly: each is the farthest from those chosen before it.

    Exact: the same points as the textbook's algorithm chooses, the lowest index among equals.

    Parameters
    ----------
    points : array of shape (n, 3)
        Positions; taken as float32.
    count : int
        How many to choose, 1 to n.
    start : int, default=0
        The first of them.
    n_jobs : int, default=None
        Threads; None and -1 mean one per core. The result does not depend on it.

    Returns
    -------
    chosen : int64 array of shape (count,)
        Indices in the order of choice.
    nearest : int64 array of shape (n,)
        For every point the nearest chosen one, as a position in ``chosen``.

    Examples
    --------
    >>> import numpy as np, cags
    >>> line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]])
    >>> chosen, nearest = cags.farthest_point_sample(line, 3)
    >>> chosen, nearest
    (array([0, 3, 2]), array([0, 0, 2, 1]))
    """
    points = cloud(points)
    if not 1 <= count <= len(points):
        raise ValueError(f"count is {count}: expected 1 to {len(points)}, the number of points")
    if not 0 <= start < len(points):
        raise ValueError(f"start is {start}: expected 0 to {len(points) - 1}")
    return _native.farthest_point_sample(points, int(count), int(start), threads_of(n_jobs))


def nearest_neighbours(points, k, *, n_jobs=None):
    """Find the nearest other points of every point.

    Parameters
    ----------
    points : array of shape (n, 3)
        Positions; taken as float32.
    k : int
        Neighbours of each, from 1.
    n_jobs : int, default=None
        Threads; None and -1 mean one per core. The result does not depend on it.

    Returns
    -------
    int64 array of shape (n, k)
        Indices, nearest first, the lowest among equals. Rows are filled up with the point itself where there are fewer than k
        others.

    Examples
    --------
    >>> import numpy as np, cags
    >>> cags.nearest_neighbours(np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), 2)
    array([[1, 2],
           [0, 2],
           [1, 0]])
    """
    points = cloud(points)
    if k < 1:
        raise ValueError(f"k is {k}: expected 1 or more")
    return _native.nearest_neighbours(points, int(k), threads_of(n_jobs))
