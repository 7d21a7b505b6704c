#!/usr/bin/env python3
"""search_readings.py: which reading of the paper does best, and what each choice is worth.

    scripts/search_readings.py plan 1|2|3 > FILE.plan     then: target/release/bench run FILE.plan --out FILE.json
    scripts/search_readings.py effects FILE.json          main effects and the best rows, as Markdown

Round 1 spreads readings and settings of HDBSCAN evenly over all factors. Round 2 is a full factorial around the best of it, round 3
one of HDBSCAN's settings and what still moved. Each has a seed of its own for tuning, and no scene is a room: rooms only report.
"""
import itertools
import json
import random
import sys

BASE = {"loss": "printed", "init": "uniform", "unit-length": "never", "norm-axis": "channel", "neighbours": "gaussians",
        "last-relu": "true", "bias": "false", "tau": "0.1", "lr": "0.001", "weight-lr": "0.001", "levels": "large", "gate": "0.7"}
HDBSCAN = {"min-cluster-size": "20", "min-samples": "5", "epsilon": "0", "select": "eom", "noise": "nearest"}
ROUNDS = {
    "1": ({"init": ["uniform", "normal-small"], "unit-length": ["never", "before", "after"], "norm-axis": ["channel", "gaussian"],
           "neighbours": ["gaussians", "anchors", "anchor-inputs"], "last-relu": ["true", "false"], "bias": ["false", "true"],
           "loss": ["printed", "self", "half-mask", "cross-view", "pixel", "gaussian"], "tau": ["0.05", "0.1", "0.2"],
           "lr": ["0.001", "0.003", "0.01"], "weight-lr": ["0.001", "0.01"], "gate": ["0.7", "0"], "levels": ["large", "medium"]},
          {"min-cluster-size": ["10", "20", "30", "60"], "min-samples": ["3", "5", "10", "30"],
           "epsilon": ["0", "0.05", "0.1", "0.3"], "select": ["eom", "leaf"], "noise": ["nearest", "keep"]}),
    "2": ({"loss": ["gaussian", "printed"], "init": ["normal-small", "uniform"], "unit-length": ["after", "before"],
           "norm-axis": ["gaussian", "channel"], "tau": ["0.2", "0.1"], "lr": ["0.001", "0.01"]}, {"noise": ["nearest", "keep"]}),
    "3": ({"tau": ["0.2", "0.4"], "lr": ["0.01", "0.03"]},
          {"min-cluster-size": ["20", "30", "60"], "min-samples": ["3", "10"], "select": ["eom", "leaf"], "noise": ["nearest", "keep"]}),
}
# The best of round 2, which round 3 goes on from.
BEST = {"loss": "gaussian", "init": "normal-small", "unit-length": "after", "norm-axis": "gaussian"}
# Readings of round 1; settings of HDBSCAN that are drawn for each, and how many of them are run.
READINGS, DRAWN, RUN = 48, 6, 4
SCENES = """\
scene {0} | --family {0} --objects {1} --views {2} --width 240 --height 180 --points {3} | --iterations 1000 --max-gaussians 12000"""
FAMILIES = [("studio", 14, 32, 5000), ("table", 24, 32, 5000), ("kitchen", 24, 36, 6000)]


def spread(factors, count, rng):
    """As many combinations as `count`, in which every level of a factor comes as often as the others."""
    columns = []
    for levels in factors.values():
        column = (levels * (count // len(levels) + 1))[:count]
        rng.shuffle(column)
        columns.append(column)
    return [dict(zip(factors, row)) for row in zip(*columns)]


def factorial(factors):
    return [dict(zip(factors, row)) for row in itertools.product(*factors.values())]


def plan(number):
    readings, clusterings = ROUNDS[number]
    if number == "1":
        rng = random.Random(1)
        chosen = spread(readings, READINGS, rng)
        settings = spread(clusterings, READINGS * DRAWN, rng)
        pairs = [(r, settings[i * DRAWN:i * DRAWN + RUN]) for i, r in enumerate(chosen)]
    else:
        pairs = [(r, factorial(clusterings)) for r in factorial(readings)]
    lines = [SCENES.format(*family) for family in FAMILIES]
    lines += [f"seeds | tuning | {int(number) - 1}", "masks | --boundary-noise 1 --missing 0.05"]
    pixels = "--pixel-samples 64" if number == "1" else ""
    lines += [f"footprints gate-{gate.replace('.', '-')} | --gate {gate} {pixels}" for gate in ("0.7", "0")]
    lines.append(f"table round-{number} | 0.5 | - | Readings of the paper, round {number}")
    settings = {}
    for i, (reading, of_reading) in enumerate(pairs):
        whole = {**BASE, **(BEST if number == "3" else {}), **reading}
        options = " ".join(f"--{k} {v}" for k, v in whole.items() if k != "gate")
        options += " --pixels 16" if whole["loss"] == "pixel" else ""
        lines.append(f"features f{i} | gate-{whole['gate'].replace('.', '-')} | --preset literal --iterations 2000 {options}")
        for clustering in of_reading:
            c = {**HDBSCAN, **clustering}
            options = " ".join(f"--{k} {v}" for k, v in c.items() if k != "select") + (" --leaf" if c["select"] == "leaf" else "")
            if options not in settings:
                settings[options] = f"c{len(settings)}"
                lines.append(f"clustering {settings[options]} | --cluster free {options}")
            label = " ".join(f"{k}={v}" for k, v in {**reading, **clustering}.items())
            lines.append(f"row round-{number} | f{i} | {settings[options]} | - | {label}")
    return "\n".join(lines)


def inverse(matrix):
    n = len(matrix)
    rows = [row[:] + [float(i == j) for j in range(n)] for i, row in enumerate(matrix)]
    for c in range(n):
        pivot = max(range(c, n), key=lambda r: abs(rows[r][c]))
        rows[c], rows[pivot] = rows[pivot], rows[c]
        rows[c] = [v / rows[c][c] for v in rows[c]]
        for r in range(n):
            if r != c:
                rows[r] = [a - rows[r][c] * b for a, b in zip(rows[r], rows[c])]
    return [row[n:] for row in rows]


def effects(path):
    """Least squares on all factors at once: what a level adds to the mean over the levels of its factor, with 95 % intervals."""
    table = json.load(open(path))["tables"][0]
    rows = [(dict(p.split("=") for p in r["label"].split()), 100 * r["results"]["0.5"]["instance_miou"]["mean"]) for r in table["rows"]]
    factors = {f: sorted({r[f] for r, _ in rows}) for f in rows[0][0]}
    columns = [(f, level) for f, levels in factors.items() for level in levels[:-1]]
    design = [[1.0] + [(r[f] == level) - (r[f] == factors[f][-1]) for f, level in columns] for r, _ in rows]
    normal = inverse([[sum(x[i] * x[j] for x in design) for j in range(len(design[0]))] for i in range(len(design[0]))])
    right = [sum(x[i] * y for x, (_, y) in zip(design, rows)) for i in range(len(design[0]))]
    found = [sum(a * b for a, b in zip(row, right)) for row in normal]
    left = [y - sum(a * b for a, b in zip(x, found)) for x, (_, y) in zip(design, rows)]
    variance = sum(v * v for v in left) / (len(rows) - len(found))
    print("| factor | what a level adds, points of instance mIoU (95 % interval) |\n|---|---|")
    for f, levels in factors.items():
        at = [1 + columns.index((f, level)) for level in levels[:-1]]
        # The last level is minus the sum of the others.
        weights = [[float(i == j) for j in at] for i in at] + [[-1.0] * len(at)]
        cells = []
        for level, w in zip(levels, weights):
            mean = sum(a * found[i] for a, i in zip(w, at))
            spread = sum(a * b * normal[i][j] for a, i in zip(w, at) for b, j in zip(w, at)) * variance
            cells.append(f"{level}: {mean:+.1f} ± {1.96 * spread ** 0.5:.1f}")
        print(f"| {f} | {', '.join(cells)} |")
    print("\n| instance mIoU, % | |\n|---|---|")
    for r, y in sorted(rows, key=lambda row: -row[1])[:8]:
        print(f"| {y:.1f} | {', '.join(f'{k} {v}' for k, v in r.items())} |")


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "plan" and sys.argv[2] in ROUNDS:
        print(plan(sys.argv[2]))
    elif len(sys.argv) == 3 and sys.argv[1] == "effects":
        effects(sys.argv[2])
    else:
        sys.exit(__doc__)
