#!/usr/bin/env python3
"""virtual_views.py: instances from renders of the Gaussians alone beside those from the photographs, of the same Gaussians.

    scripts/virtual_views.py [--scenes table-10,kitchen-10] [--photographs FOLDER]

For each scene of synth-scene (family-seed), and the desk in --photographs, it trains Gaussians on the photographs, makes views of
them (gs-geom views), masks of both with the same SAM (slow, once), and instances of both by the defaults, without held-out views. It compares both
labels of every Gaussian with the truth and with each other, and writes OUT/virtual-views.md and .json. Everything is kept in OUT
(out/virtual-views), so a second run makes only what is missing.
"""
import argparse
import array
import json
import struct
from collections import Counter
from pathlib import Path

from real_masks import FAMILIES, VIEWS, ceilings_of, instances_of, run, score

COLUMNS = ["scene", "looking", "views", "seen by 8", "of what can be seen", "seconds", "mIoU, photographs", "mIoU, renders", "points lost",
           "ARI", "in both"]
LEGEND = """\
Seen by 8: the share of the Gaussians that count in at least 8 of the renders (docs/views.md), of all and of those that can be
seen. Seconds: to choose and render the views, on the machine that ran it. mIoU: the mean over true things of the best IoU of an
instance with the thing, each counted in Gaussians, in percent; the truth of a Gaussian is that of the nearest true surface (bench
ceilings). ARI: the adjusted Rand index between both labels, over the Gaussians that have an instance in both, and the share of
these.
"""


def labels_of(instances):
    """The label of every Gaussian, -1 for none: the tensor `label` of an instances artifact."""
    data = Path(instances).read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    start, end = json.loads(data[8:8 + size])["label"]["data_offsets"]
    return array.array("i", data[8 + size + start:8 + size + end])


def miou(found, truth):
    """Mean over true things of the best IoU of an instance."""
    both = Counter((t, f) for t, f in zip(truth, found) if t >= 0 and f >= 0)
    things, instances = Counter(t for t in truth if t >= 0), Counter(f for t, f in zip(truth, found) if f >= 0 and t >= 0)
    best = dict.fromkeys(things, 0.0)
    for (t, f), n in both.items():
        best[t] = max(best[t], n / (things[t] + instances[f] - n))
    return sum(best.values()) / len(best)


def ari(a, b):
    """Adjusted Rand index of two labels over the Gaussians that have both, and the share of these."""
    pairs = [(x, y) for x, y in zip(a, b) if x >= 0 and y >= 0]
    two = lambda counts: sum(n * (n - 1) / 2 for n in counts.values())
    together, rows, columns = two(Counter(pairs)), two(Counter(x for x, _ in pairs)), two(Counter(y for _, y in pairs))
    expected = rows * columns / (len(pairs) * (len(pairs) - 1) / 2)
    return (together - expected) / (0.5 * (rows + columns) - expected), len(pairs) / len(a)


def compare(name, photographs, options, a):
    """A scene's figures."""
    folder = a.out / name
    folder.mkdir(parents=True, exist_ok=True)
    truth = photographs is None
    scene = folder / "scene" if truth else photographs
    if truth and not (scene / "truth/scene.json").exists():
        family, _, seed = name.rpartition("-")
        run("synth-scene", "--out", scene, "--family", family, "--seed", seed, "--objects", FAMILIES[family], "--views", VIEWS,
            "--width", 640, "--height", 480, "--points", 12000, "--corruption", "exact")
    base, renders = folder / "g0", folder / "views"
    if not Path(f"{base}.ply").exists():
        run("gs-geom", "train", "--scene", scene, *options, "--out", f"{base}.ply")
    if not (renders / "views.json").exists():
        run("gs-geom", "views", "--geometry", f"{base}.ply", "--out", renders, "--views", a.views)
    masks = {"photographs": ("masks", folder / "masks"), "renders": ("view-masks", folder / "view-masks")}
    of = {}
    for kind, (key, made) in masks.items():
        dataset = scene if kind == "photographs" else renders
        # Goes on where it was, and does nothing where all views are done.
        run("mask-embed", "masks", "--scene", dataset, "--sam", a.sam, "--out", made)
        own = base if kind == "photographs" else folder / "g0-views"
        if own != base and not Path(f"{own}.ply").exists():
            Path(f"{own}.ply").symlink_to(f"{base.name}.ply")
        graph, prints = (Path(f"{own}.{key}.{what}.safetensors") for what in ("graph", "footprints"))
        if not (graph.exists() and prints.exists()):
            run("graph-precompute", "--scene", dataset, "--geometry", f"{own}.ply", "--masks", made, "--holdout", 0, "--footprints",
                prints, "--graph", graph)
        of[kind] = instances_of(dataset, (key, made), own, "default")
    told = json.loads((renders / "views.json").read_text())
    seconds = json.loads(Path(f"{renders}.run.json").read_text())["wall_seconds"]
    labels = {kind: labels_of(i) for kind, i in of.items()}
    agreement, shared = ari(labels["photographs"], labels["renders"])
    row = {"scene": name, "look": told["look"], "views": len(told["views"]), "coverage": told["coverage"], "seconds": seconds,
           "ari": agreement, "in_both": shared, "miou": {}}
    if truth:
        true = next(f for what, f, _ in ceilings_of(scene, masks["photographs"], base) if what.endswith("true labels"))
        row["miou"] = {kind: miou(of, labels_of(true)) for kind, of in labels.items()}
        row["eval_score"] = score(scene, base, of["photographs"], None)["instance_miou"]
    return row


def line(row):
    percent = lambda v: "–" if v is None else f"{100 * v:.1f}"
    ours, theirs = row["miou"].get("renders"), row["miou"].get("photographs")
    lost = None if ours is None else theirs - ours
    cells = [row["scene"], row["look"], row["views"], percent(row["coverage"]["seen_by_8"]), percent(row["coverage"]["reachable_by_8"]),
             f"{row['seconds']:.0f}", percent(theirs), percent(ours), percent(lost), f"{row['ari']:.3f}", percent(row["in_both"])]
    return "| " + " | ".join(map(str, cells)) + " |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default="table-10,kitchen-10,room-10,studio-10", help="names with commas between [%(default)s]")
    parser.add_argument("--photographs", type=Path, help="folder of the desk's photographs")
    parser.add_argument("--views", type=int, default=VIEWS, help="most renders [%(default)s, as many as photographs]")
    parser.add_argument("--sam", type=Path, default=Path("models"), help="folder of the SAM model [models]")
    parser.add_argument("--out", type=Path, default=Path("out/virtual-views"), help="folder [out/virtual-views]")
    a = parser.parse_args()
    work = [(s, None, ["--resolution", "320px", "--iterations", "1500", "--sh-degree", "0"]) for s in a.scenes.split(",") if s]
    if a.photographs:
        work.append(("desk", a.photographs, ["--resolution", "640px", "--iterations", "3000"]))
    rows = []
    for name, photographs, options in work:
        rows.append(compare(name, photographs, options, a))
        print(line(rows[-1]), flush=True)
    table = [LEGEND, "| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|", *map(line, rows)]
    (a.out / "virtual-views.md").write_text("\n".join(table) + "\n")
    (a.out / "virtual-views.json").write_text(json.dumps(rows, indent=1))
    print(a.out / "virtual-views.md")


if __name__ == "__main__":
    main()
