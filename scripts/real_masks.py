#!/usr/bin/env python3
"""real_masks.py: instances from a real SAM's masks of ray-traced photographs, whose truth is exact.

    scripts/real_masks.py [--scenes kitchen-0,room-10] [--geometries 3] [--photographs FOLDER]

For each scene (family-seed; seeds 0 to 2 are for tuning, 10 to 14 for reporting) it makes photographs, masks (slow, once),
and Gaussians of several seeds, runs each method of METHODS, and writes OUT/real-masks.md and OUT/scores.json. Everything is
kept in OUT (out/real-masks), so a second run makes only what is missing. --photographs scores the desk of testdata/desk too.
"""
import argparse
import json
import os
import statistics
import subprocess
from pathlib import Path

BIN = Path(os.environ.get("BIN", "target/release"))
FAMILIES = {"studio": 14, "table": 24, "kitchen": 24, "room": 24}
TUNING, REPORTING = [0, 1, 2], [10, 11, 12, 13, 14]
VIEWS = 32
LARGE = (["--levels", "large"], ["--level", "large"])
# Name: masks, options of feat-train, options of cluster-match.
METHODS = {
    "default": ("masks", [], []),
    "large level only": ("masks", *LARGE),
    "true masks, default": ("true", [], []),
    "true masks, large level only": ("true", *LARGE),
}


def run(program, *args):
    subprocess.run([BIN / program, *map(str, args), "--quiet"], check=True, stdout=subprocess.DEVNULL)


def score(folder, scene, masks, method, geometry, labels):
    """The scores of one method on one geometry."""
    key, feat, cluster = METHODS[method]
    base = folder / f"{geometry.stem}.{method.replace(' ', '-').replace(',', '')}"
    graph, prints = (folder / f"{geometry.stem}.{key}.{what}.safetensors" for what in ("graph", "footprints"))
    features, instances = (Path(f"{base}.{what}.safetensors") for what in ("features", "instances"))
    if not instances.exists():
        if not graph.exists():
            run("graph-precompute", "--scene", scene, "--geometry", geometry, "--masks", masks, "--footprints", prints,
                "--graph", graph)
        inputs = ["--geometry", geometry, "--graph", graph, "--footprints", prints]
        run("feat-train", *inputs, "--out", features, *feat)
        run("cluster-match", "--scene", scene, *inputs, "--features", features, "--masks", masks, "--out", instances,
            *cluster)
    out = Path(f"{base}.{labels.name if labels else 'truth'}.score.json")
    if not out.exists():
        marks = ["--labels", labels] if labels else []
        run("eval", "score", "--scene", scene, "--geometry", geometry, "--instances", instances, "--out", out, *marks)
    return json.loads(out.read_text())


def main():
    everything = [f"{family}-{seed}" for seed in TUNING + REPORTING for family in FAMILIES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", default=",".join(everything), help="names with commas between [all 32]")
    parser.add_argument("--geometries", type=int, default=3, help="seeds of stage 1 for each scene [3]")
    parser.add_argument("--photographs", type=Path, help="folder of the desk's photographs")
    parser.add_argument("--sam", type=Path, default=Path("models"), help="folder of the SAM model [models]")
    parser.add_argument("--out", type=Path, default=Path("out/real-masks"), help="folder [out/real-masks]")
    a = parser.parse_args()
    scenes = [s for s in a.scenes.split(",") if s]
    for name in scenes:
        family, _, seed = name.rpartition("-")
        if family not in FAMILIES or not seed.isdigit():
            parser.error(f"--scenes: {name!r} is no scene; expected a name such as kitchen-10, of {', '.join(FAMILIES)}")
    # Scene, photographs, options of stage 1, whether true masks are there, folders of labels.
    work = [(name, a.out / name / "scene", ["--resolution", "320px", "--iterations", "1500", "--sh-degree", "0"], True, [None])
            for name in scenes]
    if a.photographs:
        labels = [Path("testdata/desk"), Path("testdata/desk-full")]
        work.append(("desk", a.photographs, ["--resolution", "640px", "--iterations", "3000"], False, labels))
    scores = {}
    for name, scene, options, true, labels in work:
        folder = a.out / name
        folder.mkdir(parents=True, exist_ok=True)
        if true and not (scene / "truth/scene.json").exists():
            family, _, seed = name.rpartition("-")
            run("synth-scene", "--out", scene, "--family", family, "--seed", seed, "--objects", FAMILIES[family],
                "--views", VIEWS, "--width", 640, "--height", 480, "--points", 12000, "--corruption", "exact")
        # Goes on where it was, and does nothing where all views are done.
        run("mask-embed", "masks", "--scene", scene, "--sam", a.sam, "--out", folder / "masks")
        for seed in range(a.geometries):
            geometry = folder / f"g{seed}.ply"
            if not geometry.exists():
                run("gs-geom", "train", "--scene", scene, *options, "--seed", seed, "--out", geometry)
            for method, (key, _, _) in METHODS.items():
                if key == "true" and not true:
                    continue
                masks = scene / "language_features" if key == "true" else folder / "masks"
                for marks in labels:
                    s = score(folder, scene, masks, method, geometry, marks)
                    row = scores.setdefault((f"{name}: {marks.name}" if marks else name, method), [])
                    row.append({k: s[k] for k in ("instance_miou", "ap25", "ap50", "label_miou")})
        print(f"{name} is done", flush=True)
    (a.out / "scores.json").write_text(json.dumps([{"scene": k[0], "method": k[1], "scores": v} for k, v in scores.items()]))

    def cell(values):
        values = [v for v in values if v is not None]
        if not values:
            return "–"
        spread = f" ({min(values):.3f} to {max(values):.3f})" if len(values) > 1 else ""
        return f"{statistics.mean(values):.3f}{spread}"

    lines = ["| scene | method | instance mIoU | AP25 | AP50 | label mIoU |", "|---|---|---|---|---|---|"]
    for (name, method), rows in scores.items():
        columns = [cell([r[k] for r in rows]) for k in ("instance_miou", "ap25", "ap50", "label_miou")]
        lines.append(f"| {name} | {method} | {' | '.join(columns)} |")
    for what, seeds in (("tuning", TUNING), ("reporting", REPORTING)):
        for method in METHODS:
            own = [r for (name, m), rows in scores.items() for r in rows
                   if m == method and ":" not in name and int(name.rpartition("-")[2]) in seeds]
            if own:
                columns = [cell([r[k] for r in own]) for k in ("instance_miou", "ap25", "ap50")]
                lines.append(f"| **{what}** | {method} | {' | '.join(columns)} | – |")
    (a.out / "real-masks.md").write_text("\n".join(lines) + "\n")
    print(a.out / "real-masks.md")


if __name__ == "__main__":
    main()
