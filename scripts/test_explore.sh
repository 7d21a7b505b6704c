#!/usr/bin/env bash
# The tools of explore and its page in a real browser, on the demo's scene with a shorter training. The page is skipped where there
# is no chromium with its driver (Debian: apt-get install chromium chromium-driver). SCREENSHOT=file keeps a picture of the page. The
# rules for everybody's use are checked by axe-core (npm, MPL-2.0), installed once into target/; skipped where npm cannot do that.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --workspace --bins --tests
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The page selects instances, so eval query is to answer with these.
make --no-print-directory -f pipelines/demo.mk OUT="$work/demo" GEOM_ARGS='--iterations 600' CLUSTER_ARGS='--granules 0' > "$work/log" 2>&1 || { cat "$work/log"; exit 1; }
on_demo() { EXPLORE_RUN="$work/demo" EXPLORE_SCREENSHOT="${SCREENSHOT:-}" cargo test --release --workspace --test "$@" --ignored --nocapture --test-threads 1; }
on_demo door --
echo "ok: the session of docs/door.md"
for program in chromium chromedriver; do
  command -v $program > /dev/null || { echo "skipped: the browser tests of explore: no $program"; exit 0; }
done
package=axe-core@4.14.1
folder=$PWD/target/axe
export EXPLORE_AXE=$folder/node_modules/axe-core/axe.min.js
if scripts/npm_install.sh "$package" "$folder"; then
  on_demo browser --
else
  on_demo browser -- --skip everybody_can_use_it
  echo "SKIPPED: explore for everybody: npm cannot install $package: no npm, or no network?"
fi
echo "ok: the page of explore in chromium"
