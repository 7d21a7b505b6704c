#!/usr/bin/env bash
# Another program's eyes on our splats: splat-transform of PlayCanvas (npm, MIT) reads what we write, we read what it writes, and it
# splits objects by the property `instance` of our PLYs. Installed once into target/ (210 MB). Skipped where npm cannot do that.
set -euo pipefail
cd "$(dirname "$0")/.."
package=@playcanvas/splat-transform@3.7.0
folder=$PWD/target/splat-transform
skip() { echo "SKIPPED: our splats beside $package: $1"; exit 0; }

for program in npm node; do
  command -v $program > /dev/null || skip "no $program (Debian: apt-get install npm)"
done
export SPLAT_TRANSFORM=$folder/node_modules/@playcanvas/splat-transform/bin/cli.mjs
scripts/npm_install.sh "$package" "$folder" || skip "npm cannot install it: no network?"
node "$SPLAT_TRANSFORM" --version > /dev/null 2>&1 || skip "it does not start: it needs node 18 or later"

cargo test --release --workspace --test splat_transform -- --ignored --skip real_files
if [ -d ../shared/data/splats ]; then
  cargo test --release --workspace --test splat_transform -- --ignored --exact real_files_read_as_it_reads_them
else
  echo "SKIPPED: real splats: no ../shared/data/splats"
fi
echo "ok: our splats and $package agree"
