#!/usr/bin/env python3
"""peers_summary.py: the report of make peers, a line a system.

    scripts/peers_summary.py REPORT.json OUT.json

Of each system: scenes, and for each kind of masks the means of instance mIoU and query mIoU with half their 95 % intervals, the
differences from ours scene by scene, processor seconds and peak memory. Null where a system has no such figure.
"""
import json
import sys

METRICS = ["instance_miou", "query_miou", "query_miou_visible"]


def figures(row, masks):
    """The figures of a row of a table at one kind of masks."""
    of = lambda kind, metric: (row[kind].get(masks) or {}).get(metric)
    mean = {m: (of("results", m) or {}).get("mean") for m in METRICS}
    half = {f"{m}_half": (of("results", m) or {}).get("half") for m in METRICS}
    less = {f"{m}_minus_ours": of("differences", m) for m in METRICS}
    return {**mean, **half, **less, "seconds": row["seconds"].get(masks), "peak_rss_bytes": row["peak_rss_bytes"].get(masks)}


def main():
    report, out = sys.argv[1:]
    with open(report) as f:
        tables = json.load(f)["tables"]
    ceilings = {t["name"]: t for t in tables}.get("ceilings")
    lines = [
        {
            "system": row["label"],
            "scenes": [f"{s}-{seed}" for s in table["scenes"] for seed in table["seeds"]],
            "options": row["options"],
            "masks": {p: figures(row, p) for p in table["p"]},
        }
        for table in tables if table["name"] != "ceilings"
        for row in table["rows"]
    ]
    known = {row["label"]: {p: figures(row, p) for p in ceilings["p"]} for row in ceilings["rows"]} if ceilings else None
    with open(out, "w") as f:
        json.dump({"systems": lines, "ceilings": known}, f, indent=1)
        f.write("\n")


main()
