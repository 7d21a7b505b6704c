#!/bin/bash
# take_objects.sh RUN OUT: the objects of a finished run for other programs: scene.json, objects/ with a PLY each (what viewers of
# Gaussians open), meshes/ with a closed mesh each, and scene.usda for simulators: Gaussians and convex colliders.
set -euo pipefail
run=$(realpath "$1") out=$(realpath -m "$2")
cd "$(dirname "$0")/.."
mkdir -p "$out"
setting() { sed -n "s/^$1 = //p" "$run/settings.conf" 2> /dev/null | tail -1; }
geometry=$(setting GEOMETRY) scene=$(setting SCENE)
[ -n "$geometry" ] || geometry=$run/geometry.ply
# Without photographs the views of the Gaussians are the scene.
[ -n "$scene" ] || { scene=$run/scene; [ -d "$scene" ] || scene=$run/views; }
inputs=(--geometry "$geometry" --instances "$run/instances.safetensors" --quiet)
[ ! -f "$run/instances.edits.json" ] || inputs+=(--edits "$run/instances.edits.json")
named=()
[ ! -f "$run/query/query.json" ] || [ -f "$run/instances.edits.json" ] || named=(--query "$run/query/query.json")
export=target/release/export
"$export" scene "${inputs[@]}" --scene "$scene" "${named[@]}" --out "$out/scene.json"
"$export" objects "${inputs[@]}" --out "$out/objects"
"$export" meshes "${inputs[@]}" --out "$out/meshes"
"$export" usd "${inputs[@]}" --scene "$scene" --out "$out/scene.usda"
