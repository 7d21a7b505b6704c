#!/usr/bin/env python3
"""Writes what scikit-learn makes of small point sets, for the tests of crates/lib/hdbscan-exact.

Every edge of the mutual reachability graph that is dominated by one core distance ties with others, so the minimum spanning
tree is not unique, and which points stand at a cluster's rim depends on which one was taken. Hence several lists of labels a case:
those of sklearn.cluster.HDBSCAN as it comes, beside those of Python's hdbscan with its exact spanning tree (to be met closely), and those that scikit-learn's own dendrogram and tree code
gives for THE minimum spanning tree of one total order of edges: weight, smaller index, larger index, with points numbered
lexicographically by coordinates (to be met exactly, probabilities included).

usage: make_hdbscan_golden.py OUT.txt [CLUSTERABLE.npy OUT2.txt]    (needs numpy below 2.4, scikit-learn 1.9, hdbscan 0.8)
       make_hdbscan_golden.py --predict OUT.txt
       make_hdbscan_golden.py --permutations OUT.txt
A case is seven lines: name, dimension, min_cluster_size, min_samples, epsilon, eom|leaf, allow_single_cluster; coordinates;
labels; labels of the one tree; probabilities of the one tree; labels of hdbscan; outlier scores of hdbscan. The second file holds the same for the points of
CLUSTERABLE.npy, without the coordinates.

--predict writes what hdbscan's approximate_predict says: per case four lines, name, queries' coordinates, labels,
probabilities; the points are those of OUT.txt.

--permutations writes how far each library differs from itself: a line per case with its name, then for scikit-learn and for
hdbscan the least and the median adjusted Rand index between its labels of the points as they are and in PERMUTATIONS other
orders. It is 1 where the spanning tree is unique, or its ties are of no consequence.
"""
import sys

import hdbscan
import numpy as np
from sklearn.cluster import HDBSCAN
from sklearn.cluster._hdbscan._linkage import MST_edge_dtype, make_single_linkage
from sklearn.cluster._hdbscan._tree import tree_to_labels
from sklearn.datasets import make_blobs, make_moons
from sklearn.metrics import adjusted_rand_score


def one_tree(x, size, samples, eps, method, single):
    """Labels and probabilities from the spanning tree of the one total order."""
    n = len(x)
    lexicographic = np.lexsort(x.T[::-1])
    p = x[lexicographic].astype(np.float64)
    d2 = np.zeros((n, n))
    for k in range(p.shape[1]):  # the order of additions fixes the last bit
        d2 += (p[:, None, k] - p[None, :, k]) ** 2
    core = np.sqrt(np.sort(d2, axis=1)[:, min(samples, n) - 1])
    w = np.maximum(np.sqrt(d2), np.maximum(core[:, None], core[None, :]))
    # Coincident points are one point with a weight.
    w[d2 == 0] = 0.0
    assert (d2 == 0).sum(axis=1).max() < size, "a heap of coincident points that is a cluster by itself"
    a, b = np.triu_indices(n, 1)
    parent = list(range(n))

    def find(i):
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    edges = []
    for e in np.lexsort((b, a, w[a, b])):
        ra, rb = find(a[e]), find(b[e])
        if ra != rb:
            parent[max(ra, rb)] = min(ra, rb)
            edges.append((a[e], b[e], w[a[e], b[e]]))
            if len(edges) == n - 1:
                break
    dendrogram = make_single_linkage(np.array(edges, dtype=MST_edge_dtype))
    labels, probabilities = tree_to_labels(dendrogram, size, method, single, eps)
    back = np.argsort(lexicographic)
    return labels[back], probabilities[back]


def write_case(out, name, x, size, samples, eps, method, single, coordinates):
    x = (np.round(x, 4) if coordinates else x).astype(np.float32)  # rounded: a smaller file
    labels = of_sklearn(x, size, samples, eps, method, single).labels_
    one, probabilities = one_tree(x, size, samples, eps, method, bool(single))
    python = of_hdbscan(x, size, samples, eps, method, single)
    print(name, x.shape[1], size, samples, eps, method, single, file=out)
    if coordinates:
        print(*(f"{v:.7g}" for v in x.ravel()), file=out)
    print(*labels, file=out)
    print(*one, file=out)
    print(*(f"{v:.5g}" for v in probabilities), file=out)
    print(*python.labels_, file=out)
    print(*(f"{v:.5g}" for v in python.outlier_scores_), file=out)
    print(f"{name}: {x.shape}, {one.max() + 1} clusters, {(one < 0).sum()} noise; ARI between the two lists "
          f"{adjusted_rand_score(labels, one):.4f}, of hdbscan with the second {adjusted_rand_score(python.labels_, one):.4f}")


def blobs(n, d, k, std, seed):
    return make_blobs(n, d, centers=k, cluster_std=std, random_state=seed)[0]


rng = np.random.default_rng(5)
sphere = rng.normal(size=(400, 4)) * 0.15 + np.eye(4)[rng.integers(0, 4, 400)]
sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
nested = np.concatenate([blobs(200, 2, [[0, 0]], 0.1, 1), blobs(200, 2, [[1, 0]], 0.1, 2), blobs(300, 2, [[12, 3]], 1.0, 3)])
line = np.concatenate([rng.normal(c, 0.3, 60) for c in (0, 4, 9)])[:, None] * np.array([[1.0, -2.0]])
# name, points, min_cluster_size, min_samples, epsilon, method, single
CASES = [
    ("blobs2", blobs(500, 2, 5, 0.6, 0), 10, 10, 0.0, "eom", 0),
    ("blobs6", blobs(500, 6, 6, 1.0, 1), 15, 5, 0.0, "eom", 0),
    ("blobs6-leaf", blobs(400, 6, 6, 1.0, 2), 10, 5, 0.0, "leaf", 0),
    ("moons", make_moons(500, noise=0.06, random_state=3)[0], 15, 5, 0.0, "eom", 0),
    ("uniform", rng.uniform(size=(400, 3)), 8, 4, 0.0, "eom", 0),
    ("uniform-leaf", rng.uniform(size=(500, 2)), 8, 4, 0.0, "leaf", 0),
    ("sphere", sphere, 12, 6, 0.0, "eom", 0),
    ("nested", nested, 20, 10, 0.0, "eom", 0),
    ("nested-epsilon", nested, 20, 10, 0.5, "eom", 0),
    ("blobs8", blobs(500, 2, 8, 0.8, 7), 8, 5, 0.0, "leaf", 0),
    ("blobs8-epsilon", blobs(500, 2, 8, 0.8, 7), 8, 5, 0.6, "leaf", 0),
    ("uniform-epsilon", rng.uniform(size=(400, 2)), 5, 3, 0.04, "eom", 0),
    ("collinear", line, 10, 5, 0.0, "eom", 0),
    ("grid", np.round(blobs(500, 2, 4, 0.7, 4) * 4) / 4, 12, 6, 0.0, "eom", 0),
    ("duplicates", np.repeat(blobs(150, 3, 4, 0.8, 6), 3, axis=0), 12, 6, 0.0, "eom", 0),
    ("single", blobs(300, 2, 1, 0.5, 8), 20, 10, 0.0, "eom", 1),
    ("single-epsilon", blobs(300, 2, 1, 0.5, 8), 20, 10, 0.25, "eom", 1),
    ("single-leaf", blobs(300, 2, 3, 0.5, 9), 20, 10, 0.3, "leaf", 1),
]
PERMUTATIONS = 50
# None with an epsilon: of a cluster that it joined of two, hdbscan's predictions know one half only.
PREDICTED = ["blobs2", "blobs6", "moons", "sphere", "nested", "collinear", "grid", "duplicates"]


def of_hdbscan(x, size, samples, eps, method, single, **more):
    # It does not count the point itself in min_samples.
    return hdbscan.HDBSCAN(min_cluster_size=size, min_samples=samples - 1, cluster_selection_epsilon=eps,
                           cluster_selection_method=method, allow_single_cluster=bool(single), algorithm="prims_kdtree",
                           approx_min_span_tree=False, **more).fit(x.astype(np.float64))


def of_sklearn(x, size, samples, eps, method, single):
    return HDBSCAN(min_cluster_size=size, min_samples=samples, cluster_selection_epsilon=eps, cluster_selection_method=method,
                   allow_single_cluster=bool(single), algorithm="brute", copy=True).fit(x.astype(np.float64))


def as_stored(x):
    return np.array([float(f"{v:.7g}") for v in np.round(x, 4).astype(np.float32).ravel()], np.float32).reshape(x.shape)


def write_predictions(out):
    """Half of the queries lie near points, half anywhere in and around their bounding box."""
    dice = np.random.default_rng(11)
    for name, x, *rest in CASES:
        if name not in PREDICTED:
            continue
        x = as_stored(x)
        model = of_hdbscan(x, *rest, prediction_data=True)
        low, high = x.min(axis=0), x.max(axis=0)
        near = x[dice.integers(0, len(x), 100)] + dice.normal(size=(100, x.shape[1])) * 0.05 * (high - low)
        queries = as_stored(np.concatenate([near, dice.uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (100, x.shape[1]))]))
        labels, probabilities = hdbscan.approximate_predict(model, queries.astype(np.float64))
        print(name, file=out)
        print(*(f"{v:.7g}" for v in queries.ravel()), file=out)
        print(*labels, file=out)
        print(*(f"{v:.9g}" for v in probabilities), file=out)
        print(f"{name}: {(labels < 0).sum()} of {len(labels)} queries are noise")


def write_permutations(out):
    dice = np.random.default_rng(12)
    for name, x, *rest in CASES:
        x = as_stored(x)
        line = [name]
        for fit in (of_sklearn, of_hdbscan):
            own = fit(x, *rest).labels_
            scores = []
            for _ in range(PERMUTATIONS):
                order = dice.permutation(len(x))
                labels = np.empty_like(own)
                labels[order] = fit(x[order], *rest).labels_
                scores.append(adjusted_rand_score(own, labels))
            line += [f"{min(scores):.4f}", f"{np.median(scores):.4f}"]
        print(*line, file=out)
        print(*line, flush=True)


if sys.argv[1] in ("--predict", "--permutations"):
    with open(sys.argv[2], "w") as out:
        (write_predictions if sys.argv[1] == "--predict" else write_permutations)(out)
    sys.exit()
with open(sys.argv[1], "w") as out:
    for case in CASES:
        write_case(out, *case, coordinates=True)
if len(sys.argv) > 3:
    with open(sys.argv[3], "w") as out:
        write_case(out, "clusterable", np.load(sys.argv[2]), 15, 15, 0.0, "eom", 0, coordinates=False)
