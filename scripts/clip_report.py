#!/usr/bin/env python3
"""Which crop and which prompt suit a CLIP model: every pair of them, scored on the labelled photographs of testdata/desk.

    make clip-report [CLIP=models/clip] [SCENE=../shared/data/desk] [OUT=out/clip-report] [LABELS=testdata/desk]
                     [CROPS="black mean box10 box20 black,box10,box20"]

Photographs become Gaussians, masks and instances once, in OUT/run, by make scene with its settings. For each crop the masks that describe
instances are encoded, which takes most of the time; for each prompt every labelled name is asked. OUT/report.md has one table. A second run
encodes only what is missing.
"""
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

BIN = Path(os.environ.get("BIN", "target/release"))
PROMPTS = {
    "none": [],
    "a photo of a {}": ["--template", "a photo of a {}"],
    "CLIP's seven templates": ["--template", "clip"],
    "LERF's negatives": ["--negatives", "lerf"],
}
LEGEND = """\
A name's cell: IoU of its answer with the labels, mean over the photographs and only what they show; rank among all instances of the one
that fits the labels best. The first line has that instance and its own IoU, mean over the photographs of the best: what names can reach.
"""


def run(program, *args):
    command = [BIN / program, *map(str, args), "--threads", os.environ.get("THREADS", "0")]
    if subprocess.run(command, stdout=subprocess.DEVNULL).returncode:
        fail(f"{program} failed")


def fail(what):
    print(f"make clip-report: {what}", file=sys.stderr)
    sys.exit(2)


def embedded(a, crop):
    """Instances whose descriptors come from this crop, and the seconds of encoding."""
    masks, instances = a.out / crop, a.out / f"{crop}.safetensors"
    masks.mkdir(parents=True, exist_ok=True)
    for path in [*a.run.glob("masks/*_s.npy"), a.run / "masks/masks.json"]:
        link = masks / path.name
        if not link.exists():
            link.symlink_to(path.resolve())
    cluster = ["--run-dir", a.run, "--masks", masks, "--out", instances, *shlex.split(os.environ.get("CLUSTER_ARGS", "")), "--quiet"]
    draft = a.out / "draft.safetensors"
    run("cluster-match", *cluster, "--draft", draft)
    start = time.monotonic()
    run("mask-embed", "embed", "--scene", a.scene, "--masks", masks, "--only", draft, "--clip", a.clip, "--crop", crop)
    seconds = time.monotonic() - start
    run("cluster-match", *cluster, "--from", draft)
    return instances, seconds


def score(a, instances, crop, number, options):
    out = a.out / f"{crop}.{number}.json"
    run("eval", "score", "--run-dir", a.run, "--instances", instances, "--clip", a.clip, "--labels", a.labels, "--silhouette", "visible",
        "--out", out, *options, "--quiet")
    return json.loads(out.read_text())


def fitting(scores, name):
    """The instance that fits a name's labels best, and the mean over the photographs of the best IoU."""
    sums = {"–": 0}
    labels = [s for s in scores["labels"] if s["category"] == name]
    for s in labels:
        if s["instance"] is not None:
            sums[s["instance"]] = sums.get(s["instance"], 0) + s["iou"]
    return max(sums, key=sums.get), sum(s["iou"] for s in labels) / len(labels)


def line(cells):
    return f"| {' | '.join(cells)} |"


def rows(name, scores):
    """A crop's and prompt's line."""
    of = {q["text"]: q for q in scores["queries"]}
    ranks = [q["rank"] for q in of.values()]
    first = sum(r == 1 for r in ranks)
    inverse = sum(1 / r for r in ranks if r) / len(ranks)
    figures = [f"{scores['query_miou']:.3f}", f"{scores['query_macc25']:.2f}", f"{first} of {len(ranks)}", f"{inverse:.2f}"]
    return line([*name, *figures, *(f"{of[n]['iou']:.2f}; {of[n]['rank'] or '–'}" for n in sorted(of))])


def settings():
    def given(name, default):
        return os.environ.get(name) or default

    a = SimpleNamespace(
        clip=Path(given("CLIP", "models/clip")), scene=Path(given("SCENE", "../shared/data/desk")), out=Path(given("OUT", "out/clip-report")),
        labels=Path(given("LABELS", "testdata/desk")), crops=given("CROPS", "black mean box10 box20 black,box10,box20").split())
    a.run = a.out / "run"
    for name in ("image.onnx", "text.onnx"):
        if not (a.clip / name).exists():
            fail(f"CLIP={a.clip}: no {name} in it: make clip fetches a model, scripts/export_clip.py makes one")
    frames = {p.stem for p in a.labels.glob("*.json")}
    missing = frames - {p.stem for p in a.scene.glob("images/*")}
    if not frames:
        fail(f"LABELS={a.labels}: no labels (*.json) in it")
    if missing:
        fail(f"SCENE={a.scene}: no photograph {min(missing)}; expected the desk of github.com/xu-zhy/VR-project (images and sparse/0), "
             "which testdata/desk labels")
    return a


def main():
    a = settings()
    if not (a.run / "instances.safetensors").exists():
        made = subprocess.run(["make", "--no-print-directory", "-f", "pipelines/custom.mk", f"BIN={BIN}", f"SCENE={a.scene}", f"OUT={a.run}",
                               "CLIP=", a.run / "instances.safetensors"])
        if made.returncode:
            fail("make scene failed")
    lines = []
    for crop in a.crops:
        instances, seconds = embedded(a, crop)
        print(f"{crop}: encoded in {seconds:.0f} s", file=sys.stderr, flush=True)
        for number, (prompt, options) in enumerate(PROMPTS.items()):
            scores = score(a, instances, crop, number, options)
            if not lines:
                names = sorted(q["text"] for q in scores["queries"])
                fits = {n: fitting(scores, n) for n in names}
                head = ["crop", "prompt", "query mIoU", "above 0.25", "ranked first", "mean of 1 / rank", *names]
                best = [f"{scores['label_miou']:.3f}", f"{scores['label_macc25']:.2f}", "", ""]
                lines = [line(head), "|---" * len(head) + "|", line(["best there is", "", *best, *(f"{i:.2f}; no. {k}" for k, i in fits.values())])]
            lines.append(rows((crop, prompt), scores))
    manifest = json.loads((a.out / a.crops[0] / "features.json").read_text())
    model = manifest["parameters"]["model"]["name"] or a.clip.name
    count = sum(s["facts"]["features"] for s in manifest["extra"]["views"].values())
    report = f"# Crops and prompts of {model}\n\n{count} masks of {len(manifest['extra']['views'])} photographs. {LEGEND}\n" + "\n".join(lines) + "\n"
    (a.out / "report.md").write_text(report)
    print(report + f"\n{a.out / 'report.md'}")


if __name__ == "__main__":
    main()
