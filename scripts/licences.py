#!/usr/bin/env python3
"""THIRD-PARTY.md: every crate that the programs are linked from, its licence and where it comes from.

    scripts/licences.py > THIRD-PARTY.md
    scripts/licences.py --check      # fails where THIRD-PARTY.md does not agree with Cargo.lock
"""
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def linked():
    """Packages that the binaries depend on, without those of tests alone."""
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--filter-platform", "x86_64-unknown-linux-gnu"]
    data = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)
    packages = {p["id"]: p for p in data["packages"]}
    nodes = {n["id"]: n for n in data["resolve"]["nodes"]}
    seen, waiting = set(), list(data["workspace_members"])
    while waiting:
        node = waiting.pop()
        if node in seen:
            continue
        seen.add(node)
        waiting += [d["pkg"] for d in nodes[node]["deps"] if any(k["kind"] is None for k in d["dep_kinds"])]
    return sorted((packages[i] for i in seen if packages[i]["source"]), key=lambda p: (p["name"], p["version"]))


def page():
    lines = ["# Third-party crates", "", "What the programs are linked from (`scripts/licences.py > THIRD-PARTY.md`).", ""]
    lines += ["| crate | version | licence | source |", "|---|---|---|---|"]
    for p in linked():
        licence = (p["license"] or f"see {p['license_file']}").replace("/", " OR ")
        lines.append(f"| {p['name']} | {p['version']} | {licence} | {p['repository'] or ''} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    text = page()
    if "--check" in sys.argv:
        if (ROOT / "THIRD-PARTY.md").read_text() != text:
            sys.exit("THIRD-PARTY.md does not agree with Cargo.lock: run scripts/licences.py > THIRD-PARTY.md")
    else:
        sys.stdout.write(text)
