#!/bin/bash
# Cost of gs-geom's iteration against Gaussians, pixels and threads: out/bench/growth.json and growth.md, the table of
# docs/geometry.md. GAUSSIANS, WIDTHS, COUNTS (of threads) and REPEATS say what is run.
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
OUT=$PWD/out/bench
mkdir -p "$OUT"
if [ ! -e "$OUT/large/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/large" --seed 0 --objects 10 --views 16 --width 960 --height 720
fi
$CARGO bench -p gs-geom --bench growth -- --out "$OUT/growth.json" --table "$OUT/growth.md" --scene "$OUT/large" \
    --gaussians "${GAUSSIANS:-4000,8000,16000,32000,64000}" --widths "${WIDTHS:-120,240,480,960}" \
    --threads "${COUNTS:-$(nproc | awk '{for (t = 1; t < $1; t *= 2) printf "%d,", t; print $1}')}" --repeats "${REPEATS:-5}"
