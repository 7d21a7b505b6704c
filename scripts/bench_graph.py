#!/usr/bin/env python3
"""Anchors and neighbours of a million points: graph-precompute beside fpsample and pykdtree, in one run, taking turns.

    scripts/bench_graph.py POSITIONS OUT.json [RUNS]

POSITIONS is a .npy of f32 [n, 3], or a number of points: then a room with things in it and a tenth of far background is made.

Needs PyPI's numpy, scipy, fpsample and pykdtree (`make bench-graph` makes an environment with them) and the bench built.
Checks that ours is exact: every anchor is a farthest point of what was not chosen (replayed in f64), neighbours and
nearest anchors are those of scipy's tree up to equal distances.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import fpsample
import numpy as np
from pykdtree.kdtree import KDTree
from scipy.spatial import cKDTree

K = 16


def timed(f):
    start = time.perf_counter()
    result = f()
    return time.perf_counter() - start, result


def peer(p):
    m = len(p) // 10
    best = min((timed(lambda: fpsample.bucket_fps_kdline_sampling(p, m, h=h)) for h in (5, 7, 9)), key=lambda r: r[0])
    fps, anchors = best[0], p[np.asarray(best[1], np.int64)]
    knn, _ = timed(lambda: (KDTree(p).query(anchors, k=K + 1), KDTree(anchors).query(anchors, k=K + 1)))
    nearest, _ = timed(lambda: KDTree(anchors).query(p, k=1))
    return {"fps": fps, "knn": knn, "nearest": nearest, "total": fps + knn + nearest}


def ours(path, out=None):
    command = ["cargo", "bench", "-q", "-p", "graph-precompute", "--bench", "graph", "--", os.path.abspath(path), "1"]
    env = dict(os.environ, **({"GRAPH_OUT": out} if out else {}))
    run = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, env=env).stdout)
    seconds = run["runs"][0]
    seconds["fps"] += seconds.pop("tree")
    return seconds, run["peak_rss_bytes"]


def exact(p, folder):
    """Whether the bench's result is what brute force would give, up to the order of equal distances."""
    read = lambda name: np.load(f"{folder}/{name}.npy").astype(np.int64)
    anchors, nearest, knn, anchor_knn = (read(n) for n in ("anchors", "nearest", "knn", "anchor_knn"))
    anchors, nearest = anchors[:, 0], nearest[:, 0]
    p = p.astype(np.float64)
    a = p[anchors]
    close = lambda x, y: np.allclose(x, y, rtol=1e-5, atol=1e-6)
    length = lambda v: np.sqrt((v * v).sum(-1))
    good = len(np.unique(anchors)) == len(anchors)
    good &= close(length(p - a[nearest]), cKDTree(a).query(p)[0])
    good &= close(length(p[knn] - a[:, None]), cKDTree(p).query(a, k=K + 1)[0][:, 1:])
    good &= close(length(a[anchor_knn] - a[:, None]), cKDTree(a).query(a, k=K + 1)[0][:, 1:])
    # Farthest point sampling is exact when no point is farther from the first j anchors than the anchor chosen next was:
    # checked after the first 1, 2, 4, ... anchors, and at the end.
    j = 1
    while j < len(anchors):
        distances = cKDTree(a[:j]).query(p)[0]
        good &= close(distances.max(), distances[anchors[j]])
        j *= 2
    return bool(good)


def room(n, seed=7):
    """60% on the surfaces of 24 ellipsoids and boxes, 30% on floor and walls, 10% far away; one point in 200 doubled."""
    r = np.random.default_rng(seed)
    things = r.integers(0, 24, n * 6 // 10)
    center, size = r.uniform((-2, -2, 0), (2, 2, 1.5), (24, 3)), r.uniform(0.05, 0.5, (24, 3))
    v = r.normal(size=(len(things), 3))
    norm = np.where(things % 2 == 0, np.linalg.norm(v, axis=1), np.abs(v).max(1))
    parts = [v / norm[:, None] * size[things] + center[things]]
    walls = r.uniform((-4, -4, 0), (4, 4, 3), (n * 3 // 10, 3))
    axis, side = r.choice([2, 0, 0, 1, 1], len(walls)), r.integers(0, 2, len(walls))
    ends = np.array([[-4, 4], [-4, 4], [0, 0]])
    walls[np.arange(len(walls)), axis] = ends[axis, side] + r.normal(size=len(walls)) * 0.01
    far = r.normal(size=(n - len(things) - len(walls), 3))
    far *= (4 * np.exp(r.uniform(np.log(10), np.log(50), len(far))) / np.linalg.norm(far, axis=1))[:, None]
    p = np.concatenate(parts + [walls, far])[r.permutation(n)].astype(np.float32)
    p[r.choice(n, n // 200, replace=False)] = p[r.integers(0, n, n // 200)]
    return p


def main(path, out, runs):
    os.makedirs(os.path.dirname(out) or ".", exist_ok=True)
    if path.isdigit():
        made = os.path.join(os.path.dirname(out) or ".", f"positions-{path}.npy")
        np.save(made, room(int(path)))
        path = made
    p = np.ascontiguousarray(np.load(path), np.float32)
    with tempfile.TemporaryDirectory() as folder:
        _, peak = ours(path, folder)
        is_exact = exact(p, folder)
    rows = [(ours(path)[0], peer(p)) for _ in range(runs)]
    median = lambda who: {k: statistics.median(r[who][k] for r in rows) for k in rows[0][who]}
    ratios = [r[1]["total"] / r[0]["total"] for r in rows]
    result = {
        "n": len(p), "anchors": len(p) // 10, "k": K, "ours_s": median(0), "peer_s": median(1),
        "ratio_total": statistics.median(ratios), "ratio_range": [min(ratios), max(ratios)], "runs": runs,
        "peak_rss_bytes": peak, "exact": is_exact,
        "peer": "fpsample bucket_fps_kdline_sampling (best of h = 5, 7, 9) and pykdtree",
    }
    with open(out, "w") as f:
        json.dump(result, f, indent=2)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 5)
