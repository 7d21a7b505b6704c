#!/usr/bin/env python3
"""Asks a finished run for a text and takes the Gaussians of the best instance. Needs numpy only.

    examples/query.py "green kettle" [out/demo]
"""
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from read_artifacts import read

ROOT = Path(__file__).resolve().parent.parent


def ask(text, run):
    """The ranked instances of `eval query`, best first."""
    with tempfile.TemporaryDirectory() as out:
        command = [ROOT / "target/release/eval", "query", "--run-dir", run, "--text", text, "--out", out, "--quiet"]
        subprocess.run([str(c) for c in command], check=True)
        return json.loads((Path(out) / "query.json").read_text())


def main(text, run="out/demo"):
    answer = ask(text, Path(run))
    asked = answer["queries"][0]
    if not asked.get("verdict", {}).get("matches", True):
        print(f"nothing matches {text}; nearest is", end=" ")
    best = asked["ranking"][0]["instance"]
    tensors, _ = read(Path(run) / "instances.safetensors")
    chosen = tensors["label"] == best
    print(f"{text}: instance {best}, {chosen.sum()} Gaussians around {tensors['centroid'][best]}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
