#!/bin/bash
# Cost of gs-geom's iteration against Gaussians, pixels and threads: out/bench/growth.json and growth.md.
# GAUSSIANS, WIDTHS, COUNTS (of threads) and REPEATS say what is run. Finished runs are kept in
# out/bench/growth.runs: remove that folder after a change of the program.
set -euo pipefail
cd "$(dirname "$0")/.."
CARGO=${CARGO:-cargo}
OUT=$PWD/out/bench
mkdir -p "$OUT"
if [ ! -e "$OUT/large/truth/scene.json" ]; then
    $CARGO run --release -p synth-scene -- --out "$OUT/large" --seed 0 --objects 10 --views 16 --width 960 --height 720
fi
COUNTS=${COUNTS:-$(nproc | awk '{for (t = 1; t < $1; t *= 2) printf "%d,", t; print $1}')} \
    $CARGO bench -p gs-geom --bench growth -- "$OUT/growth.json" "$OUT/large"
