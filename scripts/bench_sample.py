#!/usr/bin/env python3
"""What `cluster-match --sample` saves and costs on a finished scene: seconds, and the adjusted Rand index with clustering everything.

    scripts/bench_sample.py SCENE RUN_FOLDER OUT.json [MASKS]

RUN_FOLDER holds geometry.ply, graph, footprints and features of `make demo` or `make scene`. Needs nothing but Python.
"""
import collections, json, pathlib, struct, subprocess, sys, tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
SHARES = [1, 0.5, 0.25, 0.1, 0.05]
RUNS = 3


def labels(npy):
    """The values of an i32 .npy of one dimension."""
    data = npy.read_bytes()
    start = 10 + struct.unpack_from("<H", data, 8)[0]
    return struct.unpack(f"<{(len(data) - start) // 4}i", data[start:])


def ari(a, b):
    """Adjusted Rand index; noise counts as a class."""
    pairs = lambda counts: sum(n * (n - 1) / 2 for n in counts.values())
    joint, rows, columns = pairs(collections.Counter(zip(a, b))), pairs(collections.Counter(a)), pairs(collections.Counter(b))
    expected = rows * columns / (len(a) * (len(a) - 1) / 2)
    return (joint - expected) / ((rows + columns) / 2 - expected)


def main(scene, run, out, masks=None):
    run = pathlib.Path(run)
    kept = len(labels(run / "instances.labels.npy"))
    inputs = ["--scene", scene, "--masks", masks or f"{scene}/language_features", "--geometry", run / "geometry.ply"]
    for name in ("graph", "footprints", "features"):
        inputs += [f"--{name}", run / f"{name}.safetensors"]
    rows, exact = [], None
    with tempfile.TemporaryDirectory() as folder:
        instances = pathlib.Path(folder) / "i.safetensors"
        for share in SHARES:
            sample = [] if share == 1 else ["--sample", str(int(share * kept))]
            seconds = []
            for _ in range(RUNS):
                command = [ROOT / "target/release/cluster-match", *inputs, "--cluster", "free", "--out", instances, "--quiet", *sample]
                subprocess.run(list(map(str, command)), check=True)
                record = json.loads((pathlib.Path(folder) / "i.safetensors.run.json").read_text())
                seconds.append(record["summary"]["clustering_seconds"])
            found = labels(pathlib.Path(folder) / "i.labels.npy")
            exact = exact or found
            rows.append({"share": share, "clustering_s": sorted(seconds)[RUNS // 2], "ari_to_all": ari(exact, found),
                         "instances": max(found) + 1})
            print(rows[-1], flush=True)
    pathlib.Path(out).parent.mkdir(parents=True, exist_ok=True)
    pathlib.Path(out).write_text(json.dumps({"gaussians": kept, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) > 3 else sys.exit(__doc__)
