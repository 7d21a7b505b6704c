#!/usr/bin/env bash
# The tools of explore and its page in a real browser, on the demo's scene with a shorter training. The page is skipped where there
# is no chromium with its driver (Debian: apt-get install chromium chromium-driver). SCREENSHOT=file keeps a picture of the page.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --workspace --bins --tests
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The page selects instances, so eval query is to answer with these.
make --no-print-directory -f pipelines/demo.mk OUT="$work/demo" GEOM_ARGS='--iterations 600' CLUSTER_ARGS='--granules 0' > "$work/log" 2>&1 || { cat "$work/log"; exit 1; }
on_demo() { EXPLORE_RUN="$work/demo" EXPLORE_SCREENSHOT="${SCREENSHOT:-}" cargo test --release --workspace --test "$1" -- --ignored --nocapture --test-threads 1; }
on_demo door
echo "ok: the session of docs/door.md"
for program in chromium chromedriver; do
  command -v $program > /dev/null || { echo "skipped: the browser tests of explore: no $program"; exit 0; }
done
on_demo browser
echo "ok: the page of explore in chromium"
