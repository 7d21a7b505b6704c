#!/usr/bin/env python3
"""Writes crates/hdbscan-exact/testdata/golden.txt: small point sets with the labels that scikit-learn's HDBSCAN gives.
Three lines a case: name, dimension, min_cluster_size, min_samples, epsilon, eom|leaf, allow_single_cluster, least ARI;
coordinates; labels.  Needs numpy and scikit-learn.  usage: make_hdbscan_golden.py OUT"""
import sys
import numpy as np
from sklearn.cluster import HDBSCAN
from sklearn.datasets import make_blobs, make_moons

rng = np.random.default_rng(5)


def blobs(n, d, k, std, seed):
    return make_blobs(n, d, centers=k, cluster_std=std, random_state=seed)[0]


sphere = rng.normal(size=(400, 4)) * 0.15 + np.eye(4)[rng.integers(0, 4, 400)]
sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
nested = np.concatenate([blobs(200, 2, [[0, 0]], 0.1, 1), blobs(200, 2, [[1, 0]], 0.1, 2), blobs(300, 2, [[12, 3]], 1.0, 3)])
# name, points, min_cluster_size, min_samples, epsilon, method, single, least ARI: below 1 because edges dominated by one core
# distance tie, so that the spanning tree, and with it the rim of a cluster, is not unique
CASES = [
    ("blobs2", blobs(500, 2, 5, 0.6, 0), 10, 10, 0.0, "eom", 0, 0.99),
    ("blobs6", blobs(600, 6, 6, 1.0, 1), 15, 5, 0.0, "eom", 0, 0.99),
    ("blobs6-leaf", blobs(400, 6, 6, 1.0, 2), 10, 5, 0.0, "leaf", 0, 0.99),
    ("moons", make_moons(500, noise=0.06, random_state=3)[0], 15, 5, 0.0, "eom", 0, 0.99),
    ("uniform", rng.uniform(size=(500, 3)), 8, 4, 0.0, "eom", 0, 0.95),
    ("uniform-leaf", rng.uniform(size=(500, 2)), 8, 4, 0.0, "leaf", 0, 0.95),
    ("sphere", sphere, 12, 6, 0.0, "eom", 0, 0.99),
    ("nested", nested, 20, 10, 0.0, "eom", 0, 0.99),
    ("blobs8", blobs(500, 2, 8, 0.8, 7), 8, 5, 0.0, "leaf", 0, 0.95),
    # On a grid and among duplicates distances tie by the hundred: the spanning tree is not unique.
    ("grid", np.round(blobs(500, 2, 4, 0.7, 4) * 4) / 4, 10, 6, 0.0, "eom", 0, 0.9),
    ("duplicates", np.repeat(blobs(150, 3, 4, 0.8, 6), 3, axis=0), 12, 6, 0.0, "eom", 0, 0.99),
    ("single", blobs(300, 2, 1, 0.5, 8), 20, 10, 0.0, "eom", 1, 0.99),
]
with open(sys.argv[1], "w") as out:
    for name, x, size, samples, eps, method, single, least in CASES:
        x = x.astype(np.float32)
        h = HDBSCAN(min_cluster_size=size, min_samples=samples, cluster_selection_epsilon=eps, cluster_selection_method=method,
                    allow_single_cluster=bool(single), algorithm="brute", copy=True)
        labels = h.fit_predict(x.astype(np.float64))
        print(name, x.shape[1], size, samples, eps, method, single, least, file=out)
        print(*(f"{v:.9g}" for v in x.ravel()), file=out)
        print(*labels, file=out)
        print(name, x.shape, "clusters", labels.max() + 1, "noise", (labels < 0).sum())
