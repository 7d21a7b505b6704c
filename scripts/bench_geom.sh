#!/bin/bash
# Quality for the time of gs-geom's alternatives: out/bench/geom.json, the plot and the table of docs/geometry.md.
# DESK is a folder of photographs with COLMAP poses (skipped where there is none); RESOLUTION, ITERATIONS, SEEDS, JOBS and
# MAX_GAUSSIANS say how large the runs are.
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
DESK=${DESK:-../shared/data/desk}
RESOLUTION=${RESOLUTION:-320px}
OUT=$PWD/out/bench
mkdir -p "$OUT"
if [ ! -e "$OUT/scene/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/scene" --seed 0 --objects 10 --views 30 --width 480 --height 360
fi
$CARGO bench -p gs-geom --bench geom -- --out "$OUT/geom.json" --plot "$PWD/docs/images/geometry.svg" --table "$OUT/geom.md" \
    --scene "synthetic=$OUT/scene@$RESOLUTION" --scene "desk=$(realpath -m "$DESK")@$RESOLUTION" \
    --iterations "${ITERATIONS:-250,700}" --seeds "${SEEDS:-3}" --jobs "${JOBS:-1}" --max-gaussians "${MAX_GAUSSIANS:-15000}"
