#!/usr/bin/env python3
"""Race gs-geom against OpenSplat's CPU mode: the same photographs, picture size, starting points and iterations.

    scripts/bench_opensplat.py --opensplat BINARY --scene COLMAP_FOLDER [--resolution 8] [--iterations 500,1000] [--runs 3]

The scene has images/ and sparse/0 (or sparse) as COLMAP binaries, undistorted. Every 8th photograph is withheld from both: OpenSplat is
given a copy of the model without them. Both train with full pictures from the first step, three bands of spherical harmonics and their
own rule of densification. Runs alternate. A run of one iteration is subtracted as the cost of starting. OpenSplat's splats and ours are
both rendered and scored by `gs-geom eval`. Writes out/bench/opensplat.json; needs nothing but Python.
"""
import argparse, json, os, pathlib, resource, shutil, statistics, struct, subprocess, sys, tempfile, time

ROOT = pathlib.Path(__file__).resolve().parent.parent


def read_images(path):
    """Each image of a COLMAP images.bin as (name, its bytes)."""
    data = path.read_bytes()
    count, at, out = struct.unpack_from("<Q", data)[0], 8, []
    for _ in range(count):
        start = at
        at += 4 + 7 * 8 + 4
        end = data.index(b"\0", at)
        name, at = data[at:end].decode(), end + 1
        at += 8 + 24 * struct.unpack_from("<Q", data, at)[0]
        out.append((name, data[start:at]))
    return out


def without_held_out(scene, to):
    """Copies the COLMAP model without every 8th image by name; photographs are linked."""
    model = next(d for d in (scene / "sparse/0", scene / "sparse") if (d / "images.bin").exists())
    images = read_images(model / "images.bin")
    held_out = set(sorted(name for name, _ in images)[::8])
    kept = [raw for name, raw in images if name not in held_out]
    (to / "sparse/0").mkdir(parents=True)
    (to / "sparse/0/images.bin").write_bytes(struct.pack("<Q", len(kept)) + b"".join(kept))
    for name in ("cameras.bin", "points3D.bin"):
        shutil.copy(model / name, to / "sparse/0" / name)
    (to / "images").symlink_to((scene / "images").resolve())
    return len(kept), len(held_out), struct.unpack_from("<Q", (model / "points3D.bin").read_bytes())[0]


def timed(command, cwd):
    """Wall and processor seconds of a command; its output is shown if it fails."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run([str(c) for c in command], cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wall, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{command[0]} failed:\n{done.stdout[-2000:]}")
    return {"wall_s": wall, "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}


def splats(ply):
    """The number of vertices of a PLY."""
    with open(ply, "rb") as f:
        return next(int(line.split()[2]) for line in f if line.startswith(b"element vertex"))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--opensplat", type=pathlib.Path, required=True)
    parser.add_argument("--scene", type=pathlib.Path, required=True)
    parser.add_argument("--resolution", type=int, default=8, help="divisor of the photographs' size (8)")
    parser.add_argument("--iterations", default="500,1000", help="how long to train, each on its own (500,1000)")
    parser.add_argument("--runs", type=int, default=3, help="repetitions (3)")
    parser.add_argument("--threads", type=int, default=0, help="threads of both; 0: one per core (0)")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out/bench/opensplat.json")
    args = parser.parse_args()
    args.scene, args.opensplat = args.scene.resolve(), args.opensplat.resolve()
    geom = ROOT / "target/release/gs-geom"
    threads = args.threads or os.cpu_count()
    os.environ["OMP_NUM_THREADS"] = str(threads)

    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        trained, held_out, points = without_held_out(args.scene, folder / "scene")

        def opensplat(n):
            out = folder / "theirs.ply"
            return timed([args.opensplat, folder / "scene", "-o", out, "-n", n, "-d", args.resolution, "--num-downscales", 0,
                          "--keep-crs", "--cpu"], folder), out

        def ours(n):
            out = folder / "ours.ply"
            return timed([geom, "train", "--scene", args.scene, "--resolution", args.resolution, "--iterations", n, "--out", out,
                          "--schedule", "full", "--densify", "none" if n <= 500 else "adaptive", "--quiet", "--threads", threads], folder), out

        def score(ply):
            out = folder / "score.json"
            subprocess.run([geom, "eval", "--scene", args.scene, "--resolution", str(args.resolution), "--geometry", ply, "--out", out,
                            "--holdout", "8", "--quiet"], check=True)
            return json.loads(out.read_text())

        programs = {"opensplat": opensplat, "gs-geom": ours}
        start = {name: statistics.median(run(1)[0]["wall_s"] for _ in range(args.runs)) for name, run in programs.items()}
        rows = []
        for n in map(int, args.iterations.split(",")):
            row = {"iterations": n}
            for name in programs:
                row[name] = {"runs": []}
            for _ in range(args.runs):
                for name, run in programs.items():
                    cost, ply = run(n)
                    row[name]["runs"].append(cost)
                    row[name]["gaussians"], row[name]["score"] = splats(ply), score(ply)
            for name in programs:
                rates = [n / (r["wall_s"] - start[name]) for r in row[name]["runs"]]
                row[name]["it_per_s"] = {"median": statistics.median(rates), "min": min(rates), "max": max(rates)}
            row["ratio"] = row["gs-geom"]["it_per_s"]["median"] / row["opensplat"]["it_per_s"]["median"]
            rows.append(row)
            for name in programs:
                print(f"{n} iterations, {name}: {row[name]['it_per_s']['median']:.1f} it/s, {row[name]['gaussians']} Gaussians,",
                      f"PSNR {row[name]['score']['psnr_heldout']:.2f}", flush=True)
            print(f"{n} iterations: {row['ratio']:.1f} times the iterations a second", flush=True)

    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"resolution": args.resolution, "threads": threads, "views": {"trained": trained, "held_out": held_out},
                                    "points": points, "start_s": start, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
