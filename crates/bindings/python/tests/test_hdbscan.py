"""cags.HDBSCAN: scikit-learn's own checks, all kinds of arrays, distances given, prediction, threads, Ctrl-C."""

import pickle
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="cags.HDBSCAN needs scikit-learn")

from scipy import sparse
from scipy.spatial.distance import cdist
from sklearn.cluster import HDBSCAN as Reference
from sklearn.metrics import adjusted_rand_score
from sklearn.neighbors import kneighbors_graph
from sklearn.utils.estimator_checks import parametrize_with_checks

from cags import HDBSCAN


@parametrize_with_checks([HDBSCAN(), HDBSCAN(min_samples=2, cluster_selection_method="leaf", n_jobs=1)])
def test_estimator(estimator, check):
    check(estimator)


@pytest.fixture
def blobs():
    r = np.random.default_rng(1)
    middles = r.uniform(-10, 10, (5, 3))
    return np.concatenate([m + r.normal(0, 0.5, (80, 3)) for m in middles] + [r.uniform(-12, 12, (40, 3))])


@pytest.mark.parametrize("options", [{}, {"cluster_selection_method": "leaf", "min_samples": 1}, {"min_samples": 12, "cluster_selection_epsilon": 1.0}])
def test_labels_are_scikit_learns(blobs, options):
    ours, theirs = HDBSCAN(**options).fit(blobs), Reference(**options, copy=True).fit(blobs)
    assert ours.labels_.max() >= 4
    assert adjusted_rand_score(ours.labels_, theirs.labels_) > 0.98
    alike = ours.labels_ == theirs.labels_
    if alike.all():
        np.testing.assert_allclose(ours.probabilities_, theirs.probabilities_, atol=1e-4)


def test_arrays_of_all_kinds_are_the_same(blobs):
    X = blobs.astype(np.float32)
    expected = HDBSCAN().fit(X)
    readonly = X.copy()
    readonly.flags.writeable = False
    for other in [np.asfortranarray(X), X.astype(np.float64), readonly, np.repeat(X, 2, axis=0)[::2], X.tolist()]:
        found = HDBSCAN().fit(other)
        np.testing.assert_array_equal(found.labels_, expected.labels_)
        np.testing.assert_allclose(found.probabilities_, expected.probabilities_, atol=1e-5)


def test_float64_far_away_and_of_any_size(blobs):
    expected = HDBSCAN(cluster_selection_epsilon=1.0).fit(blobs)
    for scale, move in [(1.0, 1e9), (1e-200, 0.0), (1e200, 0.0)]:
        found = HDBSCAN(cluster_selection_epsilon=scale).fit(blobs * scale + move)
        assert adjusted_rand_score(found.labels_, expected.labels_) > 0.99
        leaves = found.condensed_tree_["lambda_val"].max() * scale
        assert leaves == pytest.approx(expected.condensed_tree_["lambda_val"].max(), rel=1e-3)


def test_directions_of_any_length(blobs):
    expected = HDBSCAN(metric="cosine").fit(blobs)
    lengths = np.logspace(-200, 200, len(blobs))[:, None]
    np.testing.assert_array_equal(HDBSCAN(metric="cosine").fit(blobs * np.exp2(np.round(np.log2(lengths)))).labels_, expected.labels_)
    labels, _ = expected.approximate_predict(blobs * 1e100)
    assert adjusted_rand_score(labels, expected.labels_) > 0.8
    with pytest.raises(ValueError, match="row 0 of X is 0"):
        expected.approximate_predict(np.zeros((1, 3)))


def test_what_cannot_be_clustered_is_refused(blobs):
    with_nan, with_inf = blobs.copy(), blobs.copy()
    with_nan[3, 1], with_inf[3, 1] = np.nan, np.inf
    for X, options, words in [
        (with_nan, {}, "NaN"),
        (with_inf, {}, "infinity"),
        (np.empty((0, 3)), {}, "0 sample"),
        (np.empty((5, 0)), {}, "0 feature"),
        (blobs[:1], {}, "1 sample"),
        (blobs, {"min_samples": 1000}, r"min_samples \(1000\) must be at most"),
        (blobs, {"min_cluster_size": 1}, "min_cluster_size"),
        (blobs, {"metric": "manhattan"}, "metric"),
        (blobs, {"n_jobs": 0}, "n_jobs is 0"),
        (np.vstack([blobs, np.zeros(3)]), {"metric": "cosine"}, "row 440 of X is 0"),
        (blobs, {"metric": "precomputed"}, "distance matrix has shape"),
        (-np.ones((9, 9)), {"metric": "precomputed"}, "negative"),
        (np.arange(81.0).reshape(9, 9), {"metric": "precomputed"}, "other values"),
    ]:
        with pytest.raises(ValueError, match=words):
            HDBSCAN(**options).fit(X)


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
def test_distances_given_are_as_points(blobs, metric):
    if metric == "cosine":
        # Directions in blobs.
        blobs = blobs / np.linalg.norm(blobs, axis=1, keepdims=True) * np.linspace(1, 5, len(blobs))[:, None]
    expected = HDBSCAN(metric=metric, min_samples=3).fit(blobs)
    D = cdist(blobs, blobs, metric)
    D = 0.5 * (D + D.T)
    for given in [D, sparse.csr_matrix(D), sparse.coo_matrix(D)]:
        found = HDBSCAN(metric="precomputed", min_samples=3).fit(given)
        assert adjusted_rand_score(found.labels_, expected.labels_) > 0.98
        with pytest.raises(ValueError, match="precomputed"):
            found.approximate_predict(D)


def test_a_graph_of_neighbours_finds_the_blobs(blobs):
    expected = HDBSCAN(min_samples=5).fit(blobs)
    graph = kneighbors_graph(blobs, 20, mode="distance")
    found = HDBSCAN(metric="precomputed", min_samples=5).fit(graph)
    assert adjusted_rand_score(found.labels_, expected.labels_) > 0.9
    # A row with too few neighbours is noise; and nothing joins it.
    graph = graph.tolil()
    graph[0, :], graph[:, 0] = 0, 0
    assert HDBSCAN(metric="precomputed").fit(graph.tocsr()).labels_[0] == -1


def test_the_condensed_tree_is_a_tree_of_all_points(blobs):
    X = np.vstack([blobs, blobs[:7], blobs[:7]])
    model = HDBSCAN().fit(X)
    tree, n = model.condensed_tree_, len(X)
    points = tree[tree["child"] < n]
    np.testing.assert_array_equal(np.sort(points["child"]), np.arange(n))
    assert (points["child_size"] == 1).all()
    np.testing.assert_array_equal(np.sort(tree["child"][tree["child"] >= n]), np.arange(n + 1, tree["parent"].max() + 1))
    size = {n: n} | {int(r["child"]): int(r["child_size"]) for r in tree if r["child"] >= n}
    for cluster in np.unique(tree["parent"]):
        assert tree["child_size"][tree["parent"] == cluster].sum() == size[int(cluster)]


def test_prediction_is_that_of_python_hdbscan(blobs):
    hdbscan = pytest.importorskip("hdbscan", reason="compares with the package hdbscan")
    theirs = hdbscan.HDBSCAN(min_cluster_size=10, min_samples=9, prediction_data=True, approx_min_span_tree=False).fit(blobs)
    ours = HDBSCAN(min_cluster_size=10, min_samples=10).fit(blobs)
    assert adjusted_rand_score(ours.labels_, theirs.labels_) > 0.99
    queries = blobs[::3] + np.random.default_rng(2).normal(0, 0.3, blobs[::3].shape)
    expected, probabilities = hdbscan.approximate_predict(theirs, queries)
    labels, found = ours.approximate_predict(queries)
    assert adjusted_rand_score(labels, expected) > 0.97
    both = (labels >= 0) & (expected >= 0)
    assert np.median(np.abs(found - probabilities)[both]) < 1e-3
    with pytest.raises(ValueError, match="features"):
        ours.approximate_predict(queries[:, :2])
    assert ours.approximate_predict(np.full((1, 3), 1e300))[0].shape == (1,)


def test_a_model_can_be_kept(blobs):
    model = HDBSCAN().fit(blobs)
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(model.approximate_predict(blobs)[0], again.approximate_predict(blobs)[0])


def test_the_number_of_threads_changes_nothing(blobs):
    one = HDBSCAN(n_jobs=1).fit(blobs)
    for n_jobs in [None, -1, -2, 2, 7]:
        other = HDBSCAN(n_jobs=n_jobs).fit(blobs)
        np.testing.assert_array_equal(one.labels_, other.labels_)
        np.testing.assert_array_equal(one.condensed_tree_, other.condensed_tree_)


def test_other_threads_go_on_meanwhile():
    X = np.random.default_rng(0).normal(size=(60_000, 6))
    done = threading.Event()
    work = threading.Thread(target=lambda: (HDBSCAN(n_jobs=1).fit(X), done.set()))
    turns = 0
    work.start()
    while not done.wait(0.005):
        turns += 1
    work.join()
    assert turns > 20


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_ends_it_soon():
    X = np.random.default_rng(0).normal(size=(300_000, 12))
    # A shell that starts a job in the background has it ignore the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(1.0, lambda: signal.raise_signal(signal.SIGINT))
    start = time.monotonic()
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            HDBSCAN().fit(X)
    finally:
        signal.signal(signal.SIGINT, before)
    # A second is promised; a loaded machine may take longer. The whole takes minutes.
    assert time.monotonic() - start < 15


def test_a_forked_process_can_cluster_too(blobs):
    code = (
        "import os, numpy as np; from cags import HDBSCAN; X = np.random.default_rng(0).normal(size=(500, 3)); HDBSCAN().fit(X);"
        "pid = os.fork();\nif pid == 0:\n    HDBSCAN().fit(X); os._exit(0)\nassert os.waitpid(pid, 0)[1] == 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
