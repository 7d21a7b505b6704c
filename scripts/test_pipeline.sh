#!/usr/bin/env bash
# The pipeline as people run it: make, on a tiny synthetic scene. Shows that a second make runs nothing, that a changed
# option runs what depends on it and nothing else, that thread counts and kills do not change a byte, and that artifacts
# of different scenes do not mix. Needs the programs in target/release (make build); takes a minute or two.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --workspace --bins

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
passed=0
say() { printf '%s\n' "$*"; }
pass() { passed=$((passed + 1)); say "ok: $*"; }
fail() { say "FAILED: $*"; exit 1; }

# A tiny run of the demo's pipeline into $1 with THREADS=$2; further arguments go to make.
tiny() {
  local out=$1 threads=$2
  shift 2
  make --no-print-directory -f pipelines/demo.mk OUT="$out" THREADS="$threads" \
    SYNTH_ARGS='--seed 7 --objects 8 --views 10 --width 160 --height 120 --granularity-p 0.3' \
    GEOM_ARGS='--iterations 300 --checkpoint-every 40' \
    FEAT_ARGS="${feat:-$feat_default}" GRAPH_ARGS='--min-mask-pixels 10' QUERIES='floor' "$@"
}
feat_default='--method contrastive --iterations 300 --checkpoint-every 50'
artifacts=(scene/sparse/0/cameras.bin scene/sparse/0/images.bin scene/sparse/0/points3D.bin scene/images/frame_00001.png
  scene/truth/points.safetensors scene/truth/scene.json geometry.ply graph.safetensors footprints.safetensors
  features.safetensors instances.safetensors instances.ply)
same() { # are all artifacts of two runs the same bytes?
  local f
  for f in "${artifacts[@]}"; do
    cmp "$1/$f" "$2/$f" || return 1
  done
}
stages_of() { grep -oE 'target/release/[a-z-]+( (train|eval|embed|masks|query|score|report))?' "$1" | sed 's|.*/||' | sort | tr '\n' ',' || true; }

say "== a whole run"
tiny "$work/a" 2 > "$work/a.log" 2>&1 || { cat "$work/a.log"; fail "the pipeline"; }
for f in "${artifacts[@]}" report.html metrics.json; do [ -s "$work/a/$f" ] || fail "no $f"; done
pass "the pipeline runs from scene to report"

say "== a second make"
tiny "$work/a" 2 > "$work/again.log" 2>&1
[ -z "$(stages_of "$work/again.log")" ] || { cat "$work/again.log"; fail "a second make ran a stage"; }
pass "a second make runs no stage"

say "== one thread"
tiny "$work/b" 1 > "$work/b.log" 2>&1 || { cat "$work/b.log"; fail "the pipeline with one thread"; }
same "$work/a" "$work/b" || fail "one and two threads give different bytes"
pass "one and two threads give the same bytes"

say "== a changed option"
feat='--method contrastive --iterations 310 --checkpoint-every 50' tiny "$work/b" 1 > "$work/changed.log" 2>&1
ran=$(stages_of "$work/changed.log")
[ "$ran" = 'cluster-match,eval query,eval report,eval score,feat-train,' ] || fail "a changed feat-train option ran: $ran"
pass "a changed option runs what depends on it and nothing else"

say "== artifacts of another scene"
make --no-print-directory -f pipelines/demo.mk OUT="$work/c" SYNTH_ARGS='--seed 8 --objects 8 --views 6 --width 120 --height 90' \
  GEOM_ARGS='--iterations 30' "$work/c/geometry.ply" > "$work/c.log" 2>&1 || { cat "$work/c.log"; fail "another scene"; }
before=$(sha256sum < "$work/b/features.safetensors")
code=0
target/release/feat-train --geometry "$work/c/geometry.ply" --graph "$work/b/graph.safetensors" \
  --footprints "$work/b/footprints.safetensors" --out "$work/b/features.safetensors" 2> "$work/mixed.log" || code=$?
[ "$code" = 2 ] || fail "mixed artifacts: exit code $code"
[ "$(grep -c 'error:' "$work/mixed.log")" = 1 ] || fail "mixed artifacts: not one line of error"
[ "$before" = "$(sha256sum < "$work/b/features.safetensors")" ] || fail "mixed artifacts: an output was overwritten"
pass "artifacts of another scene are refused: $(grep 'error:' "$work/mixed.log")"

say "== kills"
# Kill the whole run at growing moments, then let make finish: the bytes of an undisturbed run.
kills=${KILLS:-12}
seed=${SEED:-1}
RANDOM=$seed
for ((i = 0; i < kills; i++)); do
  moment=$(awk "BEGIN { print 0.15 + $((RANDOM % 1000)) / 1000 * 2.5 }")
  setsid bash -c "$(declare -f tiny); feat_default='$feat_default'; tiny '$work/k' 2" > "$work/k.log" 2>&1 &
  child=$!
  sleep "$moment"
  kill -KILL -- "-$child" 2> /dev/null || true
  wait "$child" 2> /dev/null || true
done
tiny "$work/k" 2 > "$work/k.log" 2>&1 || { cat "$work/k.log"; fail "make after kills"; }
same "$work/a" "$work/k" || fail "kills changed the bytes"
pass "after $kills kills make ends with the bytes of an undisturbed run"

say "$passed passed, 0 failed"
