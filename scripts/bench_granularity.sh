#!/usr/bin/env bash
# Measures synthetic masks with several faults, and real ones beside them, by one instrument (docs/granularity.md):
# out/bench/granularity.md. MASKS=folder and FOOTPRINTS=file name real masks; without them only synthetic ones are measured.
set -euo pipefail
cd "$(dirname "$0")/.."
BIN=${BIN:-target/release}
OUT=${1:-out/bench/granularity}
SCENE="--family table --objects 30 --views 24 --width 400 --height 300 --points 30000 --seed 1 --quiet"
mkdir -p "$OUT"
if [ ! -e "$OUT/geometry.ply" ]; then
  "$BIN/synth-scene" $SCENE --corruption exact --out "$OUT/scene"
  "$BIN/gs-geom" train --scene "$OUT/scene" --out "$OUT/geometry.ply" --iterations 400 --quiet
fi
TABLE=$OUT.md
: > "$TABLE"
measure() { # name masks footprints
  printf '\n%s\n\n' "$1" >> "$TABLE"
  "$BIN/eval" masks --masks "$2" --footprints "$3" --out "$OUT/$1.json" >> "$TABLE"
}
if [ -n "${MASKS:-}" ]; then measure real "$MASKS" "${FOOTPRINTS:?FOOTPRINTS=file of these masks}"; fi
synthetic() { # name options
  local masks="$OUT/masks"
  "$BIN/synth-scene" $SCENE --masks-to "$masks" $2
  "$BIN/graph-precompute" --scene "$OUT/scene" --geometry "$OUT/geometry.ply" --masks "$masks" \
    --footprints "$OUT/footprints.safetensors" --graph "$OUT/graph.safetensors" --quiet
  measure "$1" "$masks" "$OUT/footprints.safetensors"
}
for p in 0 0.25 0.5 0.75; do synthetic "p-$p" "--corruption mild --granularity-p $p"; done
synthetic sam "--corruption sam"
cat "$TABLE"
