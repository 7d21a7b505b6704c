#!/usr/bin/env bash
# Captures as a hand makes them, on synthetic scenes whose truth is known: without points, the geometry ends within 1 dB of the one
# that starts from points; with poses that are off by a degree and a centimetre, --refine-poses ends within 1 dB of exact poses, and
# the instances of the whole pipeline are as good. Takes about three minutes on two cores after the build.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --workspace --bins

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
fail() { printf 'FAILED: %s\n' "$*"; exit 1; }

# The demo's pipeline on a scene of 20 views into $1; $2 is more of SYNTH_ARGS, $3 of GEOM_ARGS.
run() {
  make --no-print-directory -f pipelines/demo.mk OUT="$work/$1" \
    SYNTH_ARGS="--seed 3 --objects 6 --views 24 --width 320 --height 240 --granularity-p 0.3 $2" \
    GEOM_ARGS="--iterations 700 $3" QUERIES='' > "$work/$1.log" 2>&1 || { cat "$work/$1.log"; fail "the pipeline: $1"; }
}
figure() { # a number of a JSON file: figure FILE KEY
  grep -oE "\"$2\": *-?[0-9.]+" "$1" | head -1 | grep -oE '[-0-9.]+$'
}
psnr() { figure "$work/$1/geom_metrics.json" psnr_heldout; }
compare() { # compare WHAT A B MOST: B is at most MOST less than A
  awk -v a="$2" -v b="$3" -v most="$4" 'BEGIN { exit !(b >= a - most) }' || fail "$1: $3, more than $4 below $2"
  printf 'ok: %s: %s beside %s\n' "$1" "$3" "$2"
}

run exact '' ''
run noisy '--pose-noise 1' '--refine-poses'
compare 'PSNR from noisy poses' "$(psnr exact)" "$(psnr noisy)" 1
miou() { figure "$work/$1/score.json" instance_miou; }
compare 'mIoU of instances from noisy poses' "$(miou exact)" "$(miou noisy)" 0.05
grep -q 'scene .*geometry.ply.cameras.json' "$work/noisy.log" || fail "later stages do not use the refined cameras"

train() { target/release/gs-geom train --quiet --iterations 700 --out "$work/$1.ply" --scene "$work/$2" "${@:3}"; }
heldout() { figure "$work/$1.ply.run.json" psnr_heldout; }
cp -r "$work/exact/scene" "$work/bare"
rm "$work/bare/sparse/0/points3D.bin"
train bare bare
compare 'PSNR without points' "$(psnr exact)" "$(heldout bare)" 1

cp -r "$work/noisy/scene" "$work/both"
rm "$work/both/sparse/0/points3D.bin"
train both both --refine-poses --threads 1
train again both --refine-poses --threads 2
for suffix in '' .cameras.json; do
  cmp "$work/both.ply$suffix" "$work/again.ply$suffix" || fail "threads change bytes"
done
compare 'PSNR without points, from noisy poses' "$(psnr exact)" "$(heldout both)" 2
