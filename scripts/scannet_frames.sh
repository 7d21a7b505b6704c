#!/usr/bin/env bash
# scannet_frames.sh SCAN OUT EVERY: links every EVERY-th frame of an extracted recording (color/, pose/), by its number, with
# intrinsics, mesh and labels into OUT; last of all OUT/frames.txt, the names of the frames.
set -euo pipefail
scan=$(realpath "$1") out=$2 every=$3
[[ $every =~ ^[1-9][0-9]*$ ]] || { echo "scannet_frames.sh: EVERY: found $every, expected a number from 1" >&2; exit 2; }
rm -rf "$out"
mkdir -p "$out/color" "$out/pose"
ln -s "$scan/intrinsic" "$out/intrinsic"
find -L "$scan" -maxdepth 1 -type f \( -name '*.ply' -o -name '*.json' \) -exec ln -s -t "$out" {} +
names=()
while IFS= read -r photograph; do
  name=${photograph##*/}
  number=${name%.*}
  [[ $number =~ ^[0-9]+$ ]] && ((10#$number % every == 0)) || continue
  names+=("$name")
  ln -s "$photograph" "$out/color/$name"
  if [ -e "$scan/pose/$number.txt" ]; then ln -s "$scan/pose/$number.txt" "$out/pose/"; fi
done < <(find -L "$scan/color/" -maxdepth 1 -type f | sort -V)
[ ${#names[@]} -gt 0 ] || { echo "scannet_frames.sh: no frame of $scan/color is a multiple of $every" >&2; exit 2; }
printf '%s\n' "${names[@]}" > "$out/frames.txt"
