#!/bin/bash
# bench_base.sh REVISION: builds a revision beside this one and times all stages of both in turns: out/bench/base.md.
set -euo pipefail
cd "$(dirname "$0")/.."
revision=$(git rev-parse --verify "$1^{commit}")
tree=$PWD/out/bench/base-tree
# The same folder each time, so that what did not change is not compiled again.
if [ -e "$tree/.git" ]; then git -C "$tree" checkout -q --detach "$revision"; else git worktree add -q --detach "$tree" "$revision"; fi
(cd "$tree" && cargo build --release --workspace --bins)
target/release/bench compare pipelines/tradeoffs.plan "$tree/target/release" --work out/bench/compare \
    --out out/bench/base.json
