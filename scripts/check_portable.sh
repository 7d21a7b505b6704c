#!/bin/bash
# check_portable.sh [BIN]: runs every stage on a tiny scene with this processor's instructions, and again as a processor without
# AVX (a Westmere of 2010, by qemu-user: Debian's package of that name), and compares the scores. BIN holds the programs.
set -euo pipefail
cd "$(dirname "$0")/.."
bin=$(realpath "${1:-target/release}")
qemu=$(command -v qemu-x86_64 || command -v qemu-x86_64-static) || { echo "needs qemu-user" >&2; exit 1; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
common=(--quiet --threads 1)
"$bin/synth-scene" --out scene --size tiny --seed 1 "${common[@]}"

# stages FOLDER [EMULATOR...]
stages() {
  local out=$1
  shift
  mkdir "$out"
  local of=(--scene scene --geometry "$out/geometry.ply") masks=scene/language_features
  local linked=(--graph "$out/graph.safetensors" --footprints "$out/footprints.safetensors")
  "$@" "$bin/gs-geom" train --scene scene --out "$out/geometry.ply" --iterations 60 "${common[@]}"
  "$@" "$bin/graph-precompute" "${of[@]}" --masks $masks "${linked[@]}" "${common[@]}"
  "$@" "$bin/feat-train" --preset literal --iterations 20 --geometry "$out/geometry.ply" "${linked[@]}" \
    --out "$out/contrastive.safetensors" "${common[@]}"
  "$@" "$bin/feat-train" --geometry "$out/geometry.ply" "${linked[@]}" --out "$out/features.safetensors" "${common[@]}"
  "$@" "$bin/cluster-match" "${of[@]}" "${linked[@]}" --masks $masks \
    --out "$out/instances.safetensors" "${common[@]}"
  "$@" "$bin/eval" score "${of[@]}" --instances "$out/instances.safetensors" --out "$out/score.json" "${common[@]}"
}
stages native
stages emulated "$qemu" -cpu Westmere
python3 - <<'PYTHON'
import json
def figures(of):
    return (json.load(open(f"{of}/geometry.ply.run.json"))["summary"]["psnr_heldout"],
            100 * json.load(open(f"{of}/score.json"))["instance_miou"])
native, emulated = figures("native"), figures("emulated")
print(f"held-out PSNR {native[0]:.3f} dB, without AVX {emulated[0]:.3f}; instance mIoU {native[1]:.1f} %, without AVX {emulated[1]:.1f}")
if abs(native[0] - emulated[0]) > 0.1 or abs(native[1] - emulated[1]) > 2:
    raise SystemExit("too far apart for a difference of rounding")
PYTHON
