"""Farthest points and nearest neighbours against what they are by definition."""

import numpy as np
import pytest

import cags


@pytest.fixture
def points():
    r = np.random.default_rng(3)
    return np.concatenate([r.normal(size=(300, 3)), r.integers(0, 3, (60, 3))]).astype(np.float32)


def distances(a, b):
    d = (a[:, None].astype(np.float64) - b[None].astype(np.float64)) ** 2
    return d.sum(-1)


def test_farthest_points_are_the_textbooks(points):
    chosen, nearest = cags.farthest_point_sample(points, 40, start=7)
    to = distances(points, points)
    assert chosen[0] == 7 and chosen.dtype == np.int64
    reached = to[7].copy()
    for k in chosen[1:]:
        assert reached[k] == pytest.approx(reached.max(), rel=1e-5)
        reached = np.minimum(reached, to[k])
    to_chosen = to[:, chosen]
    np.testing.assert_allclose(to_chosen[np.arange(len(points)), nearest], to_chosen.min(axis=1), rtol=1e-5, atol=1e-9)


def test_neighbours_are_the_nearest_others(points):
    found = cags.nearest_neighbours(points, 6, n_jobs=1)
    to = distances(points, points)
    np.fill_diagonal(to, np.inf)
    expected = np.sort(to, axis=1)[:, :6]
    np.testing.assert_allclose(np.take_along_axis(to, found, axis=1), expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(found, cags.nearest_neighbours(np.asfortranarray(points), 6))


def test_far_away_digits_are_kept():
    near = np.array([[0, 0, 0], [0.25, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(cags.nearest_neighbours(near + 2.0**20, 1), [[1], [0], [1]])


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda p: cags.farthest_point_sample(p, 0), "count is 0"),
        (lambda p: cags.farthest_point_sample(p, 361), "expected 1 to 360"),
        (lambda p: cags.farthest_point_sample(p, 2, start=-1), "start is -1"),
        (lambda p: cags.nearest_neighbours(p, 0), "k is 0"),
        (lambda p: cags.nearest_neighbours(p[:, :2], 1), r"expected \(n, 3\)"),
        (lambda p: cags.nearest_neighbours(p, 1, n_jobs=0), "n_jobs is 0"),
        (lambda p: cags.nearest_neighbours(np.where(p == p[5], np.nan, p), 1), "point 5 is not finite"),
    ],
)
def test_bad_arguments_are_refused(points, call, words):
    with pytest.raises(ValueError, match=words):
        call(points)


def test_no_points_have_no_neighbours():
    assert cags.nearest_neighbours(np.empty((0, 3)), 4).shape == (0, 4)
