#!/bin/bash
# export_instances.sh RUN OUT: every instance of a finished run as a PLY of its own, which viewers of Gaussians open; all of
# them in one, with the property `instance`, is RUN/instances.ply already.
set -euo pipefail
run=$(realpath "$1") out=$(realpath -m "$2")
cd "$(dirname "$0")/.."
mkdir -p "$out"
setting() { sed -n "s/^$1 = //p" "$run/settings.conf" 2> /dev/null | tail -1; }
scene=$(setting SCENE)
scene=${scene:-$run/scene}
masks=$(setting MASKS)
[ -n "$masks" ] || { masks=$run/masks; [ -d "$masks" ] || masks=$scene/language_features; }
target/release/cluster-match --scene "$scene" --geometry "$run/geometry.ply" --graph "$run/graph.safetensors" \
  --footprints "$run/footprints.safetensors" --features "$run/features.safetensors" --masks "$masks" \
  --out "$out/instances.safetensors" --per-instance-plys "$out"
