#!/bin/bash
# langsplat_features.sh SCENE OUT: SCENE is a folder as LangSplat's preprocessing leaves it: images/, sparse/0/ and
# language_features/ with <view>_s.npy (mask ids) and <view>_f.npy (a CLIP vector per mask).
set -euo pipefail
scene=$(realpath "$1") out=$(realpath -m "$2")
cd "$(dirname "$0")/.."
make scene SCENE="$scene" MASKS="$scene/language_features" OUT="$out"
