#!/usr/bin/env python3
"""Asks a finished run for a text and takes the Gaussians of the best instance. Needs numpy only.

    examples/query.py "green kettle" [out/demo] [testdata/clip-tiny]
"""
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from read_artifacts import read

ROOT = Path(__file__).resolve().parent.parent


def scene_of(run):
    """The photographs of a run: settings.conf says, or they lie in the run, as the demo's do."""
    settings = run / "settings.conf"
    lines = settings.read_text().splitlines() if settings.exists() else []
    named = [line.split("=", 1)[1].strip() for line in lines if line.startswith("SCENE =")]
    return Path(named[-1]) if named else run / "scene"


def ask(text, run, clip):
    """The ranked instances of `eval query`, best first."""
    with tempfile.TemporaryDirectory() as out:
        command = [ROOT / "target/release/eval", "query", "--instances", run / "instances.safetensors"]
        command += ["--geometry", run / "geometry.ply", "--scene", scene_of(run), "--clip", clip]
        command += ["--text", text, "--out", out, "--quiet"]
        subprocess.run([str(c) for c in command], check=True)
        return json.loads((Path(out) / "query.json").read_text())


def main(text, run="out/demo", clip="testdata/clip-tiny"):
    answer = ask(text, Path(run), Path(clip))
    best = answer["queries"][0]["ranking"][0]["instance"]
    tensors, _ = read(Path(run) / "instances.safetensors")
    chosen = tensors["label"] == best
    print(f"{text}: instance {best}, {chosen.sum()} Gaussians around {tensors['centroid'][best]}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
