"""Files of Gaussians, pictures and their gradients against closed forms and differences."""

import struct

import numpy as np
import plyfile
import pytest

import cags


@pytest.fixture
def cloud():
    r = np.random.default_rng(5)
    n = 40
    means = r.uniform(-1, 1, (n, 3)) + [0, 0, 4]
    return cags.Gaussians(means, r.uniform(-2.5, -1, (n, 3)), r.normal(size=(n, 4)), r.normal(0, 1, n), r.normal(0, 0.3, (n, 4, 3)))


CAMERA = cags.Camera(40, 30, 35.0, 35.0, 20.0, 15.0)


def test_one_gaussian_is_what_the_equations_say():
    scale, z, f = 0.2, 4.0, 50.0
    one = cags.Gaussians([[0, 0, z]], np.full((1, 3), np.log(scale)), [[1, 0, 0, 0]], [1.0], [[[0.5, 0.2, -3.0]]])
    found = cags.render(one, cags.Camera(33, 33, f, f, 16.5, 16.5), background=(0.1, 0.2, 0.3))
    variance = (scale * f / z) ** 2 + 0.3
    x = np.arange(33) - 16
    square = x[None] ** 2 + x[:, None] ** 2
    alpha = 1 / (1 + np.exp(-1.0)) * np.exp(-0.5 * square / variance)
    alpha[alpha < 1 / 255] = 0
    color = np.maximum(0.5 + 0.28209479 * np.array([0.5, 0.2, -3.0]), 0)
    np.testing.assert_allclose(found.alpha, alpha, atol=2e-4)
    expected = alpha[..., None] * color + (1 - alpha[..., None]) * [0.1, 0.2, 0.3]
    np.testing.assert_allclose(found.rgb, expected, atol=2e-4)
    np.testing.assert_allclose(found.depth, alpha * z, atol=1e-3)


def test_gradients_are_those_of_differences():
    r = np.random.default_rng(6)
    # So wide that no pixel is near 1/255, where the picture jumps.
    n = 5
    means = r.uniform(-0.5, 0.5, (n, 3)) + np.linspace(4, 6, n)[:, None] * [0, 0, 1]
    cloud = cags.Gaussians(means, r.uniform(0.5, 0.9, (n, 3)), r.normal(size=(n, 4)), r.normal(-0.5, 0.3, n), r.normal(0, 0.2, (n, 4, 3)))
    wave = np.cos(np.arange(40) / 9) + np.sin(np.arange(30) / 7)[:, None]
    weights = [w.astype(np.float32) for w in [wave[..., None] * [1, 0.5, -0.7], 0.3 * wave, 0.1 * wave]]

    def loss(g):
        found = cags.render(g, CAMERA)
        pictures = (found.rgb, found.alpha, found.depth)
        return sum(float((w.astype(np.float64) * p).sum()) for w, p in zip(weights, pictures))

    gradient = cags.render_backward(cloud, CAMERA, *weights)
    for name in ["means", "log_scales", "rotations", "opacity_logits", "sh"]:
        analytic = getattr(gradient, name)
        assert analytic.shape == getattr(cloud, name).shape
        direction = r.normal(size=analytic.shape).astype(np.float32)
        step, sides = 5e-3, []
        for sign in (1, -1):
            moved = cags.Gaussians(*(getattr(cloud, f) + (sign * step * direction if f == name else 0) for f in
                                     ["means", "log_scales", "rotations", "opacity_logits", "sh"]))
            sides.append(loss(moved))
        numeric = (sides[0] - sides[1]) / (2 * step)
        assert float((analytic * direction).sum()) == pytest.approx(numeric, rel=0.01, abs=0.02), name


def test_the_number_of_threads_changes_no_bit(cloud):
    one, many = (cags.render(cloud, CAMERA, n_jobs=n) for n in (1, 5))
    assert (one.rgb == many.rgb).all()
    d = np.ones((30, 40, 3))
    one, many = (cags.render_backward(cloud, CAMERA, d, n_jobs=n) for n in (1, 5))
    assert (one.means == many.means).all() and (one.sh == many.sh).all()


def test_a_turned_camera_sees_the_same(cloud):
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    flat = cags.Gaussians(cloud.means, np.full((40, 3), -2.0), cloud.rotations, cloud.opacity_logits, cloud.sh[:, :1])
    moved = cags.Gaussians((flat.means - [1, 2, 3]) @ turn, flat.log_scales, flat.rotations, flat.opacity_logits, flat.sh)
    a = cags.render(flat, CAMERA)
    b = cags.render(moved, cags.Camera(40, 30, 35.0, 35.0, 20.0, 15.0, turn, [1, 2, 3]))
    np.testing.assert_allclose(a.rgb, b.rgb, atol=1e-3)


@pytest.mark.parametrize("name, error", [("a.ply", 0), ("a.compressed.ply", 2e-3), ("a.spz", 1e-3), ("a.splat", 1e-6), ("a.glb", 1e-6)])
def test_files_come_back(cloud, tmp_path, name, error):
    path = tmp_path / name
    cags.write_ply(path, cloud)
    found = cags.read_ply(path)
    # Some formats have an order of their own.
    a, b = (g.means[np.lexsort(np.round(g.means, 2).T)] for g in (cloud, found))
    assert len(found) == 40 and np.abs(a - b).max() <= error
    if name == "a.ply":
        assert all((getattr(found, f) == getattr(cloud, f)).all() for f in ["log_scales", "rotations", "opacity_logits", "sh"])


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_plyfile_reads_what_is_written_and_its_files_are_read(tmp_path, bands):
    r = np.random.default_rng(bands)
    n, path = 5, tmp_path / "a.ply"
    cloud = cags.Gaussians(*(r.normal(size=(n, *shape)) for shape in [(3,), (3,), (4,), (), (bands, 3)]))
    cags.write_ply(path, cloud)
    vertices = plyfile.PlyData.read(path, mmap=False)["vertex"]
    of = {f"{name}{j}": column for name, columns in [("scale_", cloud.log_scales), ("rot_", cloud.rotations), ("f_dc_", cloud.sh[:, 0])]
          for j, column in enumerate(columns.T)}
    # All coefficients of red, then of green, then of blue.
    of |= {f"f_rest_{j}": column for j, column in enumerate(cloud.sh[:, 1:].transpose(2, 1, 0).reshape(-1, n))}
    of |= dict(zip("xyz", cloud.means.T), opacity=cloud.opacity_logits, nx=0, ny=0, nz=0)
    assert set(of) == set(vertices.data.dtype.names)
    for name, column in of.items():
        np.testing.assert_array_equal(vertices[name], column, name)
    for text, order in [(True, "="), (False, "<"), (False, ">")]:
        plyfile.PlyData([vertices], text=text, byte_order=order).write(path)
        found = cags.read_ply(path)
        for name in ["means", "log_scales", "rotations", "opacity_logits", "sh"]:
            np.testing.assert_array_equal(getattr(found, name), getattr(cloud, name), name)


def test_instances_are_in_the_ply(cloud, tmp_path):
    path = tmp_path / "a.ply"
    cags.write_ply(path, cloud, instance=np.arange(40) % 3 - 1)
    bytes_ = path.read_bytes()
    assert b"property int instance" in bytes_ and len(cags.read_ply(path)) == 40
    assert struct.unpack("<i", bytes_[-4:])[0] == 39 % 3 - 1
    with pytest.raises(ValueError, match=r"expected \(40,\)"):
        cags.write_ply(path, cloud, instance=[1, 2])
    with pytest.raises(ValueError):
        cags.write_ply(tmp_path / "a.spz", cloud, instance=np.zeros(40))


def test_some_of_them(cloud):
    assert len(cloud[5:9]) == 4
    np.testing.assert_array_equal(cloud[cloud.opacity_logits > 0].means, cloud.means[cloud.opacity_logits > 0])


def test_bad_input_is_refused(cloud, tmp_path):
    with pytest.raises(FileNotFoundError):
        cags.read_ply(tmp_path / "no.ply")
    damaged = tmp_path / "damaged.ply"
    damaged.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n")
    with pytest.raises(ValueError, match="damaged.ply"):
        cags.read_ply(damaged)
    with pytest.raises(ValueError, match="damaged.ply"):
        cags.write_ply(damaged / "a.ply", cloud)
    with pytest.raises(ValueError, match="rotations has the shape"):
        cags.Gaussians(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2), np.zeros((2, 1, 3)))
    with pytest.raises(ValueError, match="sh has the shape"):
        cags.Gaussians(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 4)), np.zeros(2), np.zeros((2, 2, 3)))
    for camera in [(0, 5, 1, 1, 1, 1), (5, 5, -1, 1, 1, 1), (5, 5, 1, 1, np.nan, 1), (5, 5, 1, 1, 1, 1, np.ones((3, 3)))]:
        with pytest.raises(ValueError):
            cags.Camera(*camera)
    with pytest.raises(ValueError, match="d_rgb has the shape"):
        cags.render_backward(cloud, CAMERA, np.zeros((40, 30, 3)))
    with pytest.raises(ValueError, match="near is"):
        cags.render(cloud, CAMERA, near=0)


@pytest.mark.parametrize("name, other", [
    ("means", np.zeros((39, 3), np.float32)), ("means", np.zeros((41, 3), np.float32)), ("means", np.zeros(40, np.float32)),
    ("means", np.zeros((40, 3))), ("means", np.zeros((40, 3), ">f4")), ("means", np.zeros((40, 3), complex)), ("means", None),
    ("means", [[0.0, 0.0, 4.0]] * 40), ("means", np.float32(3)), ("log_scales", np.zeros((40, 4), np.float32)),
    ("rotations", np.zeros((40, 3), np.float32)), ("opacity_logits", np.zeros((40, 1), np.float32)),
    ("opacity_logits", np.zeros(0, np.float32)), ("sh", np.zeros((40, 5, 3), np.float32)), ("sh", np.zeros((40, 4), np.float32)),
])
def test_arrays_that_no_longer_fit_are_refused(cloud, tmp_path, name, other):
    setattr(cloud, name, other)
    path = tmp_path / "a.ply"
    for use in [lambda: cags.render(cloud, CAMERA), lambda: cags.render_backward(cloud, CAMERA, np.ones((30, 40, 3))),
                lambda: cags.write_ply(path, cloud)]:
        with pytest.raises(ValueError, match="holds|has the shape"):
            use()
    assert not path.exists()


def test_arrays_in_another_order_are_the_same(cloud):
    expected = cags.render(cloud, CAMERA).rgb
    cloud.means = np.asfortranarray(cloud.means)
    cloud.sh = np.concatenate([cloud.sh, cloud.sh])[:40]
    cloud.opacity_logits = np.repeat(cloud.opacity_logits, 2)[::2]
    assert (cags.render(cloud, CAMERA).rgb == expected).all()


@pytest.mark.parametrize("name, other", [
    ("width", 0), ("width", 1 << 20), ("width", 40.5), ("width", np.nan), ("width", None), ("height", -3), ("height", np.inf),
    ("fx", np.nan), ("fx", 0), ("fy", "wide"), ("cx", np.inf), ("cy", None), ("rotation", np.full((3, 3), np.nan)),
    ("rotation", np.eye(4)), ("rotation", 2 * np.eye(3)), ("rotation", np.diag([1, 1, -1])), ("rotation", None),
    ("translation", [0, 0, np.nan]), ("translation", [0, 0]), ("translation", None),
])
def test_cameras_that_are_none_any_more_are_refused(cloud, name, other):
    good = {f: getattr(CAMERA, f) for f in ["width", "height", "fx", "fy", "cx", "cy", "rotation", "translation"]}
    with pytest.raises(ValueError):
        cags.Camera(**(good | {name: other}))
    camera = cags.Camera(**good)
    setattr(camera, name, other)
    with pytest.raises(ValueError):
        cags.render(cloud, camera)
    with pytest.raises(ValueError):
        cags.render_backward(cloud, camera, np.ones((30, 40, 3)))


def test_what_is_not_finite_is_not_drawn(cloud):
    broken = cags.Gaussians(*(np.copy(getattr(cloud, f)) for f in ["means", "log_scales", "rotations", "opacity_logits", "sh"]))
    broken.means[4] = np.nan
    rest = cloud[np.arange(40) != 4]
    np.testing.assert_allclose(cags.render(broken, CAMERA).rgb, cags.render(rest, CAMERA).rgb, atol=1e-6)


def test_nothing_is_the_background():
    none = cags.Gaussians(*(np.zeros(s) for s in [(0, 3), (0, 3), (0, 4), (0,), (0, 1, 3)]))
    assert (cags.render(none, CAMERA, background=(0, 1, 0)).rgb == [0, 1, 0]).all()


def test_a_scene_far_from_the_origin_keeps_its_digits(cloud, tmp_path):
    shift = (448262.0, 5411932.0, 114.0)
    far = cags.Gaussians(cloud.means, cloud.log_scales, cloud.rotations, cloud.opacity_logits, cloud.sh, shift=shift)
    for name in ["far.ply", "far.glb"]:
        cags.write_ply(tmp_path / name, far)
        found = cags.read_ply(tmp_path / name)
        assert found.shift == shift and found[3:5].shift == shift
        np.testing.assert_allclose(found.means, cloud.means, atol=1e-6)
    with pytest.raises(ValueError, match="three finite numbers"):
        cags.Gaussians(cloud.means, cloud.log_scales, cloud.rotations, cloud.opacity_logits, cloud.sh, shift=(0, np.nan, 0))
