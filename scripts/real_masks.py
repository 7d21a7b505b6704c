#!/usr/bin/env python3
"""real_masks.py: instances from a real SAM's masks of scenes with a truth: ray-traced, scanned rooms, photographs with labels.

    scripts/real_masks.py [--scenes kitchen-0,room-10] [--geometries 3] [--scans FOLDER] [--photographs desk=FOLDER]

For each scene (family-seed; seeds 0 to 2 are for tuning, 10 to 14 for reporting) it makes photographs, masks (slow, once),
and Gaussians of several seeds, runs each method of METHODS, asks bench for the ceilings, and writes OUT/real-masks.md and
OUT/scores.json. Everything is kept in OUT (out/real-masks), so a second run makes only what is missing. --scans takes renders of
scanned rooms (scan.py), --photographs the captures whose labels lie in testdata.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

BIN = Path(os.environ.get("BIN", "target/release"))
FAMILIES = {"studio": 14, "table": 24, "kitchen": 24, "room": 24}
TUNING, REPORTING = [0, 1, 2], [10, 11, 12, 13, 14]
VIEWS = 32
LARGE = (["--levels", "large"], ["--levels", "large"])
# Name: masks, options of feat-train, options of cluster-match. A method's files have its name: rename it where options change.
METHODS = {
    "default": ("masks", [], []),
    "large level only": ("masks", *LARGE),
    "true masks, default": ("true", [], []),
    "true masks, large level only": ("true", *LARGE),
}
# With level classes of panoptic models, from nearly perfect ones to bad ones (panoptic_faults.py).
PANOPTIC = {f"with classes, faults {n}": (f"faults-{n}", [], []) for n in range(5)}
METHODS.update(PANOPTIC)
# What a scene's other methods are measured by.
WHOLE = "true masks, large level only"
COLUMNS = {"instance_miou": "instance mIoU", "object_miou": "things mIoU", "ap25": "AP25", "ap50": "AP50", "label_miou": "label mIoU", "impure": "impure masks",
           "found": "share found", "pq": "PQ"}
LEGEND = f"""\
A scene's figure is the mean over its geometries (least to most). A figure of several scenes is the mean of theirs (least to most
over scenes; largest distance between two geometries of one scene). The share of true masks is a scene's figure over that of
"{WHOLE}". Ceilings: true labels on the Gaussians; the masks of a level, each given the thing that
has most of it, and Gaussians that take the thing with most weight in their masks. Impure masks: the share of the masks' weight
in masks of which less than 80 % is one thing. Found: things that some instance fits with an IoU above 0.5. PQ: the panoptic quality
of the classes, in percent.
"""


def run(program, *args):
    subprocess.run([BIN / program, *map(str, args), "--quiet"], check=True, stdout=subprocess.DEVNULL)


def graph_of(scene, masks, base):
    """Graph and footprints of masks on the geometry `base`.ply; `masks` is a folder with its name in files."""
    key, folder = masks
    graph, prints = (Path(f"{base}.{key}.{what}.safetensors") for what in ("graph", "footprints"))
    if not (graph.exists() and prints.exists()):
        run("graph-precompute", "--scene", scene, "--geometry", f"{base}.ply", "--masks", folder, "--footprints", prints,
            "--graph", graph)
    return graph, prints


def instances_of(scene, masks, base, method):
    """The instances of a method, from masks, on the geometry `base`.ply."""
    _, feat, cluster = METHODS[method]
    own = f"{base}.{method.replace(' ', '-').replace(',', '')}"
    features, instances = (Path(f"{own}.{what}.safetensors") for what in ("features", "instances"))
    if not instances.exists():
        graph, prints = graph_of(scene, masks, base)
        inputs = ["--geometry", f"{base}.ply", "--graph", graph, "--footprints", prints]
        learned = []
        if "--cluster" in cluster:
            run("feat-train", *inputs, "--out", features, *feat)
            learned = ["--features", features]
        run("cluster-match", "--scene", scene, *inputs, *learned, "--masks", masks[1], "--out", instances, *cluster)
    return instances


def ceilings_of(scene, masks, base):
    """The ceilings of a scene with a truth: name, instances, share of impure masks."""
    out = Path(f"{base}.{masks[0]}.ceilings.json")
    if not out.exists():
        run("bench", "ceilings", "--scene", scene, "--geometry", f"{base}.ply", "--footprints",
            graph_of(scene, masks, base)[1], "--out", out)
    for ceiling in json.loads(out.read_text()):
        ideal = "" if ceiling["masks"] is None else " masks, ideal grouping"
        yield f"ceiling: {ceiling['name']}{ideal}", out.parent / ceiling["instances"], ceiling["impure"]


def with_classes(scene, folder, key):
    """SAM's id maps of a scene in folder/masks with the level classes of a panoptic model; writes its quality beside them."""
    if not (folder / f"{key}.pq").exists():
        script = [sys.executable, Path(__file__).parent / "panoptic_faults.py", scene, folder / "masks", folder / key]
        done = subprocess.run([*script, "--faults", key.rpartition("-")[2]], check=True, capture_output=True, text=True)
        (folder / f"{key}.pq").write_text(done.stdout)
    return key, folder / key


def score(scene, base, instances, labels, impure=None):
    """The scores of instances on the geometry `base`.ply, by polygons in the folder `labels` or by the scene's truth."""
    own = str(instances).removesuffix(".safetensors").removesuffix(".instances")
    out = Path(f"{own}.{labels.name if labels else 'truth'}.score.json")
    if not out.exists():
        marks = ["--labels", labels] if labels else []
        run("eval", "score", "--scene", scene, "--geometry", f"{base}.ply", "--instances", instances, "--out", out, *marks)
    scores = json.loads(out.read_text())
    things = [t["iou"] > 0.5 for t in scores.get("things", []) if not t["background"] and t["points"] >= 100]
    return {**scores, "impure": impure, "found": statistics.mean(things) if things else None}


def spread(values):
    return f"{min(values):.3f} to {max(values):.3f}"


def one(values):
    """Of one scene: the mean over its geometries."""
    return f"{statistics.mean(values):.3f}" + (f" ({spread(values)})" if len(values) > 1 else "") if values else "–"


def several(scenes):
    """Of several scenes, each with its geometries."""
    scenes = [s for s in scenes if s]
    means = [statistics.mean(s) for s in scenes]
    apart = f"; {max(max(s) - min(s) for s in scenes):.3f}" if any(len(s) > 1 for s in scenes) else ""
    return f"{statistics.mean(means):.3f}" + (f" ({spread(means)}{apart})" if len(means) > 1 else "") if means else "–"


def table(scores):
    """Markdown of `scores`: by scene, then method, the scores of its geometries."""
    def values(scene, method, column):
        return [r[column] for r in scores[scene].get(method, []) if r.get(column) is not None]

    def share(scene, method, column):
        own, whole = values(scene, method, column), values(scene, WHOLE, column)
        return [statistics.mean(own) / statistics.mean(whole)] if own and whole and any(whole) else []

    def line(name, method, cells):
        return f"| {name} | {method} | {' | '.join(cells)} |"

    lines = [LEGEND, line("scene", "method", COLUMNS.values()), "|---" * (len(COLUMNS) + 2) + "|"]
    for scene in scores:
        lines += [line(scene, method, [one(values(scene, method, c)) for c in COLUMNS]) for method in scores[scene]]
    drawn = [(s, int(s.rpartition("-")[2])) for s in scores if s.partition("-")[0] in FAMILIES]
    groups = {what: [s for s, seed in drawn if seed in seeds] for what, seeds in (("tuning", TUNING), ("reporting", REPORTING))}
    groups["scans"] = [s for s in scores if s.startswith("scan ")]
    for what, own in groups.items():
        methods = list(dict.fromkeys(method for s in own for method in scores[s]))
        for name, of in ((what, values), (f"{what}, share of true masks", share)):
            lines += [line(f"**{name}**", method, [several([of(s, method, c) for s in own]) for c in COLUMNS])
                      for method in methods if of is values or (what != "scans" and method != WHOLE)]
    return "\n".join(lines) + "\n"


def arguments():
    everything = [f"{family}-{seed}" for seed in TUNING + REPORTING for family in FAMILIES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", help="ray-traced scenes, names with commas between [all 32; none with --scans or --photographs]")
    parser.add_argument("--geometries", type=int, default=3, help="seeds of stage 1 for each scene [3]")
    parser.add_argument("--scans", type=Path, help="folder of scans, NAME_vert.npy and labels; scan.py says what they hold")
    parser.add_argument("--photographs", default="", help="captures with labels in testdata: desk=FOLDER,room=FOLDER,blanket=FOLDER")
    parser.add_argument("--panoptic", action="store_true", help="also with the classes of panoptic models of five qualities")
    parser.add_argument("--sam", type=Path, default=Path("models"), help="folder of the SAM model [models]")
    parser.add_argument("--out", type=Path, default=Path("out/real-masks"), help="folder [out/real-masks]")
    a = parser.parse_args()
    if a.scenes is None:
        a.scenes = "" if a.scans or a.photographs else ",".join(everything)
    a.scenes = [s for s in a.scenes.split(",") if s]
    pairs = [p.partition("=") for p in a.photographs.split(",") if p]
    a.photographs = {name: Path(folder) for name, _, folder in pairs}
    if a.scans and not list(a.scans.glob("*_vert.npy")):
        parser.error(f"--scans: no NAME_vert.npy in {a.scans}")
    for name, folder in a.photographs.items():
        if not (Path("testdata") / name).is_dir() or not folder.is_dir():
            parser.error(f"--photographs: there is no folder {folder}, or no labels in testdata/{name}")
    for name in a.scenes:
        family, _, seed = name.rpartition("-")
        if family not in FAMILIES or not seed.isdigit():
            parser.error(f"--scenes: {name!r} is no scene; expected a name such as kitchen-10, of {', '.join(FAMILIES)}")
    return a


def main():
    a = arguments()
    # Scene, photographs, options of stage 1, whether true masks are there, folders of labels (None: the truth).
    work = [(name, a.out / name / "scene", ["--resolution", "320px", "--iterations", "1500", "--sh-degree", "0"], True, [None])
            for name in a.scenes]
    scans = {p.name.removesuffix("_vert.npy"): p for p in sorted(a.scans.glob("*_vert.npy"))} if a.scans else {}
    for name, file in scans.items():
        scene = a.out / f"scan {name}" / "scene"
        if not (scene / "truth/points.safetensors").exists():
            subprocess.run([sys.executable, Path(__file__).parent / "scan.py", str(file).removesuffix("_vert.npy"), scene,
                            "--views", "48", "--overwrite", "--quiet"], check=True)
        work.append((f"scan {name}", scene, ["--resolution", "640px", "--iterations", "1500", "--holdout", "0"], False, [None]))
    for name, folder in a.photographs.items():
        labels = [p for p in (Path("testdata") / name, Path(f"testdata/{name}-full")) if p.is_dir()]
        work.append((name, folder, ["--resolution", "640px", "--iterations", "3000"], False, labels))
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
        masks = {"masks": ("masks", folder / "masks"), "true": ("true", scene / "language_features")}
        if a.panoptic and (scene / "truth/views").exists():
            masks.update((key, with_classes(scene, folder, key)) for key, _, _ in PANOPTIC.values())
        for seed in range(a.geometries):
            base = folder / f"g{seed}"
            if not Path(f"{base}.ply").exists():
                run("gs-geom", "train", "--scene", scene, *options, "--seed", seed, "--out", f"{base}.ply")
            made = [(method, instances_of(scene, masks[key], base, method), None)
                    for method, (key, _, _) in METHODS.items() if key in masks and (true or key != "true")]
            made += ceilings_of(scene, masks["masks"], base) if true else []
            for method, instances, impure in made:
                for marks in labels:
                    row = scores.setdefault(f"{name}: {marks.name}" if marks else name, {}).setdefault(method, [])
                    s = score(scene, base, instances, marks, impure)
                    pq = folder / f"{METHODS.get(method, [''])[0]}.pq"
                    s["pq"] = float(pq.read_text()) if pq.exists() else None
                    row.append({k: s.get(k) for k in COLUMNS})
        print(f"{name} is done", flush=True)
    (a.out / "scores.json").write_text(
        json.dumps([{"scene": n, "method": m, "scores": v} for n, of in scores.items() for m, v in of.items()]))
    (a.out / "real-masks.md").write_text(table(scores))
    print(a.out / "real-masks.md")


if __name__ == "__main__":
    main()
