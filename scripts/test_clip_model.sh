#!/usr/bin/env bash
# A CLIP of ViT-B/16's size, random weights and so many layers (2; 12 is the whole) in out/clip-random-LAYERS, and the engines beside ONNX
# Runtime on it; and the pixels that CLIP is shown. Skipped where there is no Python 3.9 or later, or its packages cannot be had.
set -euo pipefail
cd "$(dirname "$0")/.."
layers=${1:-2} env=out/clip-python model=out/clip-random-${1:-2}
python=${PYTHON:-python3}
"$python" -c 'import sys, venv; sys.exit(sys.version_info < (3, 9))' 2> /dev/null \
  || { echo "SKIPPED: CLIP beside ONNX Runtime: $python is not Python 3.9 or later with venv"; exit 0; }
if [ ! -e "$env/ready" ]; then
  mkdir -p out
  { "$python" -m venv "$env" && "$env/bin/pip" install -q 'numpy<3' 'onnx>=1.17,<2' 'onnxruntime>=1.20,<1.29' pillow opencv-python-headless && touch "$env/ready"; } \
    || { echo "SKIPPED: CLIP beside ONNX Runtime: pip cannot get numpy, onnx, onnxruntime, pillow and opencv-python-headless"; exit 0; }
fi
[ -x target/release/mask-embed ] || cargo build --release --workspace --bins
"$env/bin/python" scripts/test_crops.py
# Made anew where the script changed: a model that was cut has no sum.
made=$(sha256sum scripts/make_clip_random.py crates/lib/onnx-models/testdata/tokens.json)
if [ "$(cat "$model/made" 2> /dev/null)" != "$made" ]; then
  rm -rf "$model"
  "$env/bin/python" scripts/make_clip_random.py --layers "$layers" "$model"
  echo "$made" > "$model/made"
fi
library=$(ls "$env"/lib/python*/site-packages/onnxruntime/capi/libonnxruntime.so.* | head -n 1)
export ORT_DISABLE_TELEMETRY=1 ORT_TEST_LIBRARY=$PWD/$library CLIP_TEST=$PWD/$model
cargo test --release --workspace --test engines --test full_clip -- --include-ignored --nocapture 2>&1 | grep -E '^test |^error|panicked|most|off|FAILED|failed' \
  | tee "$model/said"; [ "${PIPESTATUS[0]}" = 0 ]
echo "ok: a CLIP of full width and $layers layers, beside ONNX Runtime"
