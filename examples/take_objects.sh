#!/bin/bash
# take_objects.sh RUN OUT: the objects of a finished run for other programs: scene.json, objects/ with a PLY each (what viewers of
# Gaussians open), meshes/ with a closed mesh each, and scene.usda for simulators: Gaussians and convex colliders.
set -euo pipefail
run=$(realpath "$1") out=$(realpath -m "$2")
cd "$(dirname "$0")/.."
mkdir -p "$out"
inputs=(--run-dir "$run" --quiet)
named=()
[ ! -f "$run/query/query.json" ] || [ -f "$run/instances.edits.json" ] || named=(--query "$run/query/query.json")
export=target/release/export
"$export" scene "${inputs[@]}" "${named[@]}" --out "$out/scene.json"
"$export" objects "${inputs[@]}" --out "$out/objects"
"$export" meshes "${inputs[@]}" --out "$out/meshes"
"$export" usd "${inputs[@]}" --out "$out/scene.usda"
