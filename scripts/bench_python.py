#!/usr/bin/env python3
"""HDBSCAN from Python: cags beside scikit-learn, hdbscan, fast_hdbscan and hdbscan-rs, in one run, taking turns.

    scripts/bench_python.py OUT.md [--points 10000x2,1000000x6] [--runs 3]

Each fit runs in a process of its own on all cores, on 40 blobs of different density with 15 % scattered points. Seconds are those of
the fit alone, after a small one that compiles what is compiled late: of the clock, and of the process's processors, which other work
on the machine changes less (workers that a library starts as processes of their own are not in them); the plot has the latter. A
library is left out, with a word, where a fit takes over 10 minutes or 16 GB, or would by what it took for a tenth of the points. It
makes OUT.json and OUT.svg too. `make bench-python` makes the environment. min_samples counts the point itself here, in scikit-learn
and in hdbscan-rs; the others get one less.
"""
import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

SIZE, SAMPLES = 100, 10
LONGEST, MOST = 600.0, 16e9
# Name in the table: package, and how the fit is called.
LIBRARIES = {
    "cags": ("cags", "cags.HDBSCAN(min_cluster_size={size}, min_samples={samples})"),
    "hdbscan-rs": ("hdbscan-rs", "hdbscan_rs.HDBSCAN(min_cluster_size={size}, min_samples={samples})"),
    "fast_hdbscan": ("fast-hdbscan", "fast_hdbscan.HDBSCAN(min_cluster_size={size}, min_samples={samples} - 1)"),
    "hdbscan": ("hdbscan", "hdbscan.HDBSCAN(min_cluster_size={size}, min_samples={samples} - 1, core_dist_n_jobs=-1)"),
    "scikit-learn": ("scikit-learn", "sklearn.cluster.HDBSCAN(min_cluster_size={size}, min_samples={samples}, n_jobs=-1, copy=True)"),
}
FIT = r"""
import re, sys, time, numpy as np, {module}
make = lambda: {call}
make().fit(np.random.default_rng(0).normal(size=(2000, {dim})))
x = np.load(sys.argv[1])
before, spent = time.perf_counter(), time.process_time()
found = make().fit_predict(x)
seconds, spent = time.perf_counter() - before, time.process_time() - spent
np.save(sys.argv[2], np.asarray(found, np.int32))
print(seconds, spent, int(re.search(r'VmHWM:\s*(\d+)', open('/proc/self/status').read())[1]) * 1024)
"""


def blobs(n, d, seed=11):
    r = np.random.default_rng(seed)
    centers, spreads = r.uniform(-3, 3, (40, d)), np.exp(r.uniform(np.log(0.03), np.log(0.15), 40))
    truth = r.choice(40, n, p=(w := r.lognormal(0, 0.8, 40)) / w.sum())
    x = centers[truth] + r.normal(size=(n, d)) * spreads[truth, None]
    scattered = r.random(n) < 0.15
    x[scattered] = r.uniform(-3.8, 3.8, (scattered.sum(), d))
    return ((x - x.mean(0)) / x.std(0)).astype(np.float32)


def fit(library, points, dim, labels):
    """Seconds of the clock, of all processors, and peak memory of a fit in bytes; or in words why there are none."""
    call = LIBRARIES[library][1].format(size=SIZE, samples=SAMPLES)
    module = call[: call.index(".HDBSCAN")]
    child = subprocess.Popen([sys.executable, "-W", "ignore", "-c", FIT.format(module=module, call=call, dim=dim), points, labels],
                             stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + LONGEST + 60
    why = None
    try:
        while child.poll() is None and why is None:
            time.sleep(0.2)
            pages = Path(f"/proc/{child.pid}/statm")
            used = int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if pages.exists() else 0
            why = "over 16 GB" if used > MOST else "over 10 minutes" if time.monotonic() > end else None
    finally:
        # Also where this program is ended: what is left would work beside the next run.
        child.kill()
    out, errors = child.communicate()
    if why or child.returncode:
        return why or errors.strip().splitlines()[-1]
    seconds, spent, peak = map(float, out.split())
    return (seconds, spent, peak) if seconds <= LONGEST else "over 10 minutes"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="table to write")
    parser.add_argument("--points", default=",".join(f"{n}x{d}" for d in (2, 6, 16) for n in (10_000, 100_000, 1_000_000)),
                        help="points x dimensions with commas between [%(default)s]")
    parser.add_argument("--runs", type=int, default=3, help="fits of each that takes under a minute; others get one [%(default)s]")
    a = parser.parse_args()
    a.out.parent.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    from sklearn.metrics import adjusted_rand_score

    rows, last = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for n, d in (map(int, p.split("x")) for p in a.points.split(",")):
            points = f"{folder}/points.npy"
            np.save(points, blobs(n, d))
            row = {"points": n, "dim": d, "seconds": {}, "processor_seconds": {}, "bytes": {}, "ari": {}, "left_out": {}}
            for run in range(a.runs):
                for library in LIBRARIES:
                    before, earlier = (last.get((library, n // by, d)) for by in (10, 100))
                    taken = row["seconds"].get(library, [])
                    if library in row["left_out"] or taken and taken[0] > 60:
                        continue
                    # As it grew so far, in proportion at least.
                    if not isinstance(before, str) and before and before * max(10, before / (earlier or before)) > LONGEST:
                        before = "over 10 minutes by what a tenth took"
                    if isinstance(before, str):
                        row["left_out"][library] = last[library, n, d] = before
                        continue
                    found = fit(library, points, d, f"{folder}/{library}.npy")
                    if isinstance(found, str):
                        row["left_out"][library] = last[library, n, d] = found
                        continue
                    row["seconds"].setdefault(library, []).append(found[0])
                    row["processor_seconds"].setdefault(library, []).append(found[1])
                    row["bytes"][library] = found[2]
                    last[library, n, d] = found[0]
                    if run == 0 and library != "cags":
                        ours, theirs = (np.load(f"{folder}/{name}.npy") for name in ("cags", library))
                        row["ari"][library] = adjusted_rand_score(ours, theirs)
                    print(f"{n} x {d}, {library}: {found[0]:.2f} s, {found[1]:.2f} processor seconds, {found[2] / 1e6:.0f} MB", file=sys.stderr)
            rows.append(row)
            a.out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    versions = {library: version(package) for library, (package, _) in LIBRARIES.items()}
    a.out.write_text(table(rows, versions))
    a.out.with_suffix(".svg").write_text(plot(rows))


def cell(row, library):
    if library in row["left_out"]:
        return row["left_out"][library]
    spent, ours = row["processor_seconds"][library], statistics.median(row["processor_seconds"]["cags"])
    middle = statistics.median(spent)
    spread = f" ({min(spent):.3g} to {max(spent):.3g})" if len(spent) > 1 else ""
    ratio = "" if library == "cags" else f", {middle / ours:.1f} times, ARI {row['ari'][library]:.4f}"
    clock = statistics.median(row["seconds"][library])
    return f"{middle:.3g}{spread}{ratio}, clock {clock:.3g}, {row['bytes'][library] / 1e6:.0f} MB"


def table(rows, versions):
    head = ["points", *(f"{library} {versions[library]}" for library in LIBRARIES)]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        lines.append("| " + " | ".join([f"{row['points']:,} x {row['dim']}", *(cell(row, library) for library in LIBRARIES)]) + " |")
    return "\n".join(lines) + "\n"


def plot(rows):
    """Processor seconds against points, a panel for each number of dimensions, both axes by powers of ten."""
    colors = dict(zip(LIBRARIES, ["#c0392b", "#2471a3", "#1e8449", "#7d3c98", "#b9770e"]))
    dims = sorted({row["dim"] for row in rows})
    width, height, left, low, high = 250, 220, 46, -2.5, 3.0
    x = lambda panel, n: left + panel * (width + 40) + (np.log10(n) - 3.8) / 2.4 * width
    y = lambda s: 30 + (high - np.log10(s)) / (high - low) * height
    parts = []
    for panel, dim in enumerate(dims):
        parts.append(f'<text x="{x(panel, 1e5)}" y="18" text-anchor="middle">{dim} dimensions</text>')
        for power in range(-2, 4):
            parts.append(f'<path d="M{x(panel, 10**3.8)} {y(10.0**power)}h{width}" stroke="#ddd"/>')
            if panel == 0:
                parts.append(f'<text x="{left - 6}" y="{y(10.0**power) + 4}" text-anchor="end">{10.0**power:g} s</text>')
        for power in (4, 5, 6):
            parts.append(f'<text x="{x(panel, 10**power)}" y="{height + 46}" text-anchor="middle">{10**power:,}</text>')
        for library, color in colors.items():
            of = [(row["points"], statistics.median(row["processor_seconds"][library])) for row in rows if row["dim"] == dim and library in row["seconds"]]
            line = " ".join(f"{x(panel, n):.1f},{y(s):.1f}" for n, s in of)
            parts.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>')
            parts += [f'<circle cx="{x(panel, n):.1f}" cy="{y(s):.1f}" r="3.5" fill="{color}"/>' for n, s in of]
    for k, (library, color) in enumerate(colors.items()):
        parts.append(f'<text x="{left + 130 * k}" y="{height + 74}" fill="{color}">{library}</text>')
    total = left + len(dims) * (width + 40)
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {total} {height + 84}" font-family="sans-serif" font-size="13">'
            f'<rect width="100%" height="100%" fill="white"/>{"".join(parts)}</svg>\n')


if __name__ == "__main__":
    main()
