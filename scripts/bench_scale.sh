#!/usr/bin/env bash
# bench_scale.sh: the stages after the first on 1 and 3 million Gaussians and 300 photographs, in out/bench/scale: time and peak memory
# of each (scale.md). PYTHON has numpy. What is there already is not made again: remove the folder for a new measurement.
set -euo pipefail
bin=target/release
out=out/bench/scale
scene=$out/scene
mkdir -p "$out"
[ -s "$scene/truth/scene.json" ] || "$bin/synth-scene" --family room --objects 60 --views 300 --width 640 --height 480 --points 3000000 \
  --granularity-p 0.5 --seed 3 --out "$scene"
[ -s "$out/1.ply" ] || "$bin/gs-geom" train --scene "$scene" --iterations 40 --densify none --max-gaussians 3000000 --out "$out/1.ply"
# Every Gaussian cut into three smaller ones near its place.
[ -s "$out/3.ply" ] || "${PYTHON:-python3}" - "$out/1.ply" "$out/3.ply" 3 <<'P'
import sys
import numpy as np

source, out, parts = sys.argv[1], sys.argv[2], int(sys.argv[3])
data = open(source, "rb").read()
end = data.index(b"end_header\n") + len(b"end_header\n")
lines = data[:end].decode().split("\n")
names = [line.split()[2] for line in lines if line.startswith("property")]
rows = np.repeat(np.frombuffer(data[end:], "<f4").reshape(-1, len(names)), parts, axis=0)
random = np.random.default_rng(0)
for k, axis in enumerate("xyz"):
    size = names.index(f"scale_{k}")
    rows[:, names.index(axis)] += 0.5 * np.exp(rows[:, size]) * random.standard_normal(len(rows)).astype("f4")
    rows[:, size] -= np.log(parts) / 2
header = "\n".join(f"element vertex {len(rows)}" if line.startswith("element vertex") else line for line in lines)
open(out, "wb").write(header.encode() + rows.tobytes())
P
for size in 1 3; do
  geometry=(--scene "$scene" --geometry "$out/$size.ply")
  made=(--graph "$out/$size.graph.safetensors" --footprints "$out/$size.footprints.safetensors")
  masks=(--masks "$scene/language_features")
  run() { [ -s "${*: -1}" ] || "$@"; } # the last argument is the output
  [ -s "$out/$size.footprints.safetensors" ] || "$bin/graph-precompute" "${geometry[@]}" "${masks[@]}" --levels large "${made[@]}"
  run "$bin/feat-train" --geometry "$out/$size.ply" "${made[@]}" --out "$out/$size.features.safetensors"
  run "$bin/cluster-match" "${geometry[@]}" "${made[@]}" "${masks[@]}" --features "$out/$size.features.safetensors" \
    --out "$out/$size.instances.safetensors"
  run "$bin/eval" score "${geometry[@]}" --instances "$out/$size.instances.safetensors" --out "$out/$size.score.json"
done
"${PYTHON:-python3}" - "$out" > "$out/scale.md" <<'P'
import json, sys

stages = ["graph", "features", "instances", "score"]
print("| Gaussians | footprint entries | stage | wall seconds | CPU seconds | peak memory | forecast |\n|---|---|---|---|---|---|---|")
for size in "13":
    record = lambda name: json.load(open(f"{sys.argv[1]}/{size}.{name}.run.json"))
    graph = record("graph.safetensors")["summary"]
    for name in stages:
        r = record(name + (".json" if name == "score" else ".safetensors"))
        memory = " | ".join(f"{r[key] / 1e9:.2f} GB" for key in ["peak_rss_bytes", "memory_predicted_bytes"])
        print(f"| {graph['gaussians']:,} | {graph['entries']:,} | `{r['program']}` | {r['wall_seconds']:.0f} | {r['cpu_seconds']:.0f} | {memory} |")
P
cat "$out/scale.md"
