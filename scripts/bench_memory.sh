#!/bin/bash
# Predicted against measured peak memory of gs-geom on quite different runs: out/bench/memory.md
# (docs/performance.md, "Memory"). DESK is a folder of photographs with COLMAP poses (its runs are skipped where there is none).
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
DESK=${DESK:-../shared/data/desk}
OUT=$PWD/out/bench
mkdir -p "$OUT/memory.runs"
if [ ! -e "$OUT/scene/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/scene" --seed 0 --objects 10 --views 30 --width 480 --height 360
fi
$CARGO build --release -p gs-geom
GS_GEOM=${GS_GEOM:-target/release/gs-geom}
{
    echo '| run | Gaussians at the end | peak | predicted | predicted / peak |'
    echo '|---|---|---|---|---|'
} > "$OUT/memory.md"

# run NAME SCENE OPTIONS...
run() {
    local name=$1 scene=$2 ply="$OUT/memory.runs/run.ply"
    shift 2
    [ -d "$scene" ] || { echo "skipping $name: no folder $scene" >&2; return; }
    rm -f "$ply".*
    "$GS_GEOM" train --quiet --threads 2 --overwrite --scene "$scene" --out "$ply" "$@"
    python3 - "$name" "$*" "$ply.run.json" >> "$OUT/memory.md" <<'PYTHON'
import json, sys
name, options, path = sys.argv[1:]
record = json.load(open(path))
summary, peak = record["summary"], record["peak_rss_bytes"]
told = summary["memory_predicted_bytes"]
print(f"| {name}: `{options}` | {summary['gaussians']:,} | {peak / 2**20:.0f} MiB | {told / 2**20:.0f} MiB | {told / peak:.2f} |")
PYTHON
    tail -n 1 "$OUT/memory.md"
}

run 'synthetic, few and small' "$OUT/scene" --resolution 160px --iterations 60 --checkpoint-every 20
run 'synthetic, many and small' "$OUT/scene" --resolution 160px --iterations 16 --checkpoint-every 8 \
    --init random --init-points 300000
run 'synthetic, growing' "$OUT/scene" --resolution 160px --iterations 240 --checkpoint-every 100 \
    --densify-every 20 --max-gaussians 150000
run 'desk, few and large' "$DESK" --resolution 1 --iterations 12 --checkpoint-every 6
run 'desk, many and large' "$DESK" --resolution 960px --iterations 12 --checkpoint-every 6 \
    --init random --init-points 150000
run 'desk, small cache' "$DESK" --resolution 960px --iterations 12 --checkpoint-every 6 --image-cache 20M
