#!/bin/bash
# Quality for the time of gs-geom's alternatives: out/bench/geom.json, the plot and the table of docs/geometry.md.
# DESK is a folder of photographs with COLMAP poses (skipped where there is none); RESOLUTION, ITERATIONS, SEEDS, JOBS,
# MAX_GAUSSIANS and SETTINGS (names of settings with / between them) say what is run. What was run before is kept: stop it
# and start it again, or start with few seeds and add some. Remove out/bench/geom.json after a change of the program.
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
DESK=${DESK:-../shared/data/desk}
RESOLUTION=${RESOLUTION:-480px}
SETTINGS=${SETTINGS:-3DGS/coarse/content/absgrad, coarse/mcmc/antialias}
OUT=$PWD/out/bench
mkdir -p "$OUT"
if [ ! -e "$OUT/scene/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/scene" --seed 0 --objects 10 --views 30 --width 480 --height 360
fi
$CARGO bench -p gs-geom --bench geom -- --out "$OUT/geom.json" --plot "$PWD/docs/images/geometry.svg" --table "$OUT/geom.md" \
    --scene "synthetic=$OUT/scene@$RESOLUTION" --scene "desk=$(realpath -m "$DESK")@$RESOLUTION" \
    --iterations "${ITERATIONS:-500,2000}" --seeds "${SEEDS:-3}" --jobs "${JOBS:-1}" --max-gaussians "${MAX_GAUSSIANS:-30000}" \
    --settings "$SETTINGS"
