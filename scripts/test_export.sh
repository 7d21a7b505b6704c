#!/usr/bin/env bash
# Another program's eyes on our PLYs: splat-transform (npm, MIT) splits objects by the property `instance`, and must find the
# Gaussians that we labelled. It is taken from SPLAT_TRANSFORM or the path, else installed once into target/ (210 MB). Skipped
# where there is no npm, or where it cannot be installed.
set -euo pipefail
cd "$(dirname "$0")/.."
package=@playcanvas/splat-transform@2.7.1
folder=target/splat-transform
skip() { echo "SKIPPED: splat-transform on our PLYs: $1"; exit 0; }

program=${SPLAT_TRANSFORM:-$(command -v splat-transform || true)}
if [ -z "$program" ]; then
  program=$PWD/$folder/node_modules/.bin/splat-transform
  if [ ! -x "$program" ]; then
    command -v npm > /dev/null || skip "no npm (Debian: apt install npm)"
    timeout 300 npm install --silent --no-audit --no-fund --fetch-retries 0 --prefix "$folder" "$package" > /dev/null 2>&1 ||
      { rm -rf "$folder"; skip "npm cannot install $package: no network, or an old node?"; }
  fi
fi
"$program" --version > /dev/null 2>&1 || skip "$program does not start: it needs node 18 or later"
SPLAT_TRANSFORM=$program cargo test --release --workspace --test splat_transform -- --ignored
echo "ok: splat-transform splits objects from our PLYs"
