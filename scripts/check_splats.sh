#!/usr/bin/env bash
# Our readers and writers of splats beside those of npm's @playcanvas/splat-transform, both ways (docs/splats.md). Installs the
# program into a folder of its own, which is removed afterwards. Needs npm and node; the files of ../shared/data where they are.
set -euo pipefail
cd "$(dirname "$0")/.."
version=${1:-3.7.0}

for program in npm node; do
  command -v "$program" > /dev/null || { echo "check_splats.sh: NOT CHECKED: no $program here; install Node.js" >&2; exit 2; }
done
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
npm install --silent --no-audit --no-fund --ignore-scripts --prefix "$folder" "@playcanvas/splat-transform@$version" ||
  { echo "check_splats.sh: NOT CHECKED: npm could not install @playcanvas/splat-transform $version" >&2; exit 2; }
export SPLAT_TRANSFORM=$folder/node_modules/@playcanvas/splat-transform/bin/cli.mjs

tests=(it_reads_what_we_write we_read_what_it_writes)
if [ -d ../shared/data/splats ]; then
  tests+=(real_files_read_as_it_reads_them)
else
  echo "check_splats.sh: no ../shared/data/splats here: real files are not compared" >&2
fi
for test in "${tests[@]}"; do
  cargo test --release -q -p gs-scene --test splat_transform -- --ignored --exact "$test"
done
echo "readers and writers agree with splat-transform $version"
