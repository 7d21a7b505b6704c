#!/usr/bin/env python3
"""HDBSCAN of many points: hdbscan-exact beside hdbscan-rs and fast_hdbscan, in one run, taking turns.

    scripts/bench_cluster.py POINTS OUT.json [RUNS] [TRUTH.npy]

POINTS is a .npy of f32 [n, d], or n x d such as 1000000x6: then 40 blobs of different density and 15% scattered points
are made. Needs PyPI's numpy, scikit-learn, hdbscan-rs and fast_hdbscan (`make bench-cluster` makes an environment with
them) and the bench built. The point itself counts in min_samples here and in hdbscan-rs, not in fast_hdbscan, which gets one less.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np
from sklearn.metrics import adjusted_rand_score

SIZE, SAMPLES = 100, 10


def blobs(n, d, seed=11):
    r = np.random.default_rng(seed)
    centers, spreads = r.uniform(-3, 3, (40, d)), np.exp(r.uniform(np.log(0.03), np.log(0.15), 40))
    truth = r.choice(40, n, p=(w := r.lognormal(0, 0.8, 40)) / w.sum())
    x = centers[truth] + r.normal(size=(n, d)) * spreads[truth, None]
    scattered = r.random(n) < 0.15
    x[scattered], truth[scattered] = r.uniform(-3.8, 3.8, (scattered.sum(), d)), -1
    return ((x - x.mean(0)) / x.std(0)).astype(np.float32), truth


def ours(path, labels):
    command = ["cargo", "bench", "-q", "-p", "hdbscan-exact", "--bench", "cluster", "--", os.path.abspath(path)]
    command += [str(SIZE), str(SAMPLES), os.path.abspath(labels)]
    run = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return run["seconds"], run["peak_rss_bytes"], np.load(labels)


def peers():
    found = {}
    try:
        import hdbscan_rs

        found["hdbscan_rs"] = lambda x: hdbscan_rs.HDBSCAN(min_cluster_size=SIZE, min_samples=SAMPLES).fit_predict(x)
    except ImportError:
        print("hdbscan-rs is not there: left out", file=sys.stderr)
    try:
        import fast_hdbscan

        fast_hdbscan.HDBSCAN(min_cluster_size=5).fit(np.random.default_rng(0).normal(size=(500, 3)))  # compiles
        found["fast_hdbscan"] = lambda x: (
            fast_hdbscan.HDBSCAN(min_cluster_size=SIZE, min_samples=SAMPLES - 1).fit_predict(x)
        )
    except ImportError:
        print("fast_hdbscan is not there: left out", file=sys.stderr)
    return found


def main(points, out, runs, truth=None):
    os.makedirs(os.path.dirname(out) or ".", exist_ok=True)
    if points.endswith(".npy"):
        path, x = points, np.ascontiguousarray(np.load(points), np.float32)
        truth = np.load(truth) if truth else None
    else:
        x, truth = blobs(*map(int, points.split("x")))
        path = os.path.join(os.path.dirname(out) or ".", f"points-{points}.npy")
        np.save(path, x)
    libraries = peers()
    seconds = {name: [] for name in ("ours", *libraries)}
    aris, peak = {}, 0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs):
            took, peak, labels = ours(path, os.path.join(folder, "labels.npy"))
            seconds["ours"].append(took)
            for name, fit in libraries.items():
                start = time.perf_counter()
                theirs = np.asarray(fit(x))
                seconds[name].append(time.perf_counter() - start)
                aris[name] = adjusted_rand_score(labels, theirs)
    median = {name: statistics.median(s) for name, s in seconds.items()}
    known = truth >= 0 if truth is not None else None
    result = {
        "n": len(x), "d": x.shape[1], "min_cluster_size": SIZE, "min_samples": SAMPLES, "runs": runs,
        "seconds": median["ours"], "range": {name: [min(s), max(s)] for name, s in seconds.items()},
        "peer_seconds": {name: median[name] for name in libraries},
        "ratio": {name: statistics.median(p / o for p, o in zip(seconds[name], seconds["ours"])) for name in libraries},
        "peak_rss_bytes": peak, "ari_peer": aris,
        "ari_truth": adjusted_rand_score(truth[known], labels[known]) if truth is not None else None,
    }  # fmt: skip
    with open(out, "w") as f:
        json.dump(result, f, indent=2)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 3, *sys.argv[4:5])
