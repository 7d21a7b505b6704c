#!/usr/bin/env bash
# Trains the text-image dual encoder of the demo and the tests again: synthetic scenes, crops of their masks, captions,
# then scripts/train_clip_tiny.py. The demo's seed (0) is not among the scenes trained on.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
scenes=${SCENES:-40}
out=${OUT:-out/clip-tiny}
"$python" -c 'import numpy, jax, onnx' 2>/dev/null || {
  echo "make clip-tiny needs Python with numpy, jax and onnx: $python -m pip install numpy jax onnx" >&2
  exit 2
}
bin=target/release
for ((s = 0; s < scenes; s++)); do
  dir=$out/$(printf 'scene_%03d' "$s")
  [ -f "$dir/crops.safetensors" ] && continue
  p=$(awk "BEGIN { print ($s % 3) * 0.25 }")
  "$bin/synth-scene" --out "$dir/scene" --seed $((1000 + s)) --objects 11 --views 8 --width 480 --height 360 --granularity-p "$p" --quiet
  "$bin/mask-embed" crops --scene "$dir/scene" --masks "$dir/scene/language_features" --out "$dir/crops.safetensors" --size 64 --quiet
done
"$python" scripts/train_clip_tiny.py --crops "$out" --out testdata/clip-tiny "$@"
