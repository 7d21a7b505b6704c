#!/bin/bash
# Quality for the time of gs-geom's alternatives: out/bench/geom.json, and geom.md and geom.svg, the table and curves of docs/results/geometry.md.
# DESK is a folder of photographs with COLMAP poses (skipped where there is none); RESOLUTION, ITERATIONS, SEEDS, ONLY (settings)
# and MAX_GAUSSIANS say what is run. "handheld" is a synthetic scene whose poses are off by a tenth of a degree and a millimetre. Finished runs are kept in out/bench/geom.runs: stop it and start it again, or start with few
# seeds and add some. Remove that folder after a change of the program.
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
DESK=${DESK:-../shared/data/desk}
RESOLUTION=${RESOLUTION:-480px}
OUT=$PWD/out/bench
mkdir -p "$OUT"
if [ ! -e "$OUT/scene/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/scene" --seed 0 --objects 10 --views 30 --width 480 --height 360
fi
if [ ! -e "$OUT/handheld/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/handheld" --seed 1 --family table --objects 12 --views 30 --width 480 --height 360 --pose-noise 0.1
fi
$CARGO bench -p gs-geom --bench geom -- "$OUT/geom.json" "synthetic=$OUT/scene@$RESOLUTION" "handheld=$OUT/handheld@$RESOLUTION" \
    "desk=$(realpath -m "$DESK")@$RESOLUTION"
