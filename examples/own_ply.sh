#!/bin/bash
# own_ply.sh SCENE FILE.ply OUT: instances in Gaussians that some other tool trained. SCENE holds the posed photographs
# they were trained from (COLMAP, transforms.json); masks come from SAM (make models), or from MASKS=folder.
set -euo pipefail
scene=$(realpath "$1") ply=$(realpath "$2") out=$(realpath -m "$3")
cd "$(dirname "$0")/.."
target/release/gs-geom inspect "$ply"
make scene SCENE="$scene" GEOMETRY="$ply" OUT="$out" ${MASKS:+MASKS="$(realpath "$MASKS")"}
