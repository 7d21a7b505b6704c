#!/bin/bash
# splat_to_objects.sh FILE OUT: from a splat alone (.spz, .ply, .sog, .splat, .glb; no photographs) to its objects. SAM is
# needed once: make models.
set -euo pipefail
splat=$(realpath "$1") out=$(realpath -m "$2")
cd "$(dirname "$0")/.."
make scene GEOMETRY="$splat" OUT="$out"
examples/take_objects.sh "$out" "$out/taken"
