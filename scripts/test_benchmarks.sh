#!/usr/bin/env bash
# The pipelines of the benchmarks from first to last file, on miniatures in the layouts of the real data sets: make lerf-ovs
# (LangSplat's features; raw photographs through SAM and CLIP), make scannet (extracted recordings; OpenGaussian's
# conversion), what make check-data says of data that is missing, and make reproduce-check.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --release --workspace --bins --tests
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
passed=0
started=$SECONDS
pass() { passed=$((passed + 1)); printf 'ok: %s (%d s)\n' "$*" $((SECONDS - started)); }
fail() { printf 'FAILED: %s\n' "$*"; exit 1; }
# The pipelines without the build that make begins with.
benchmark() { make --no-print-directory -j 2 -f pipelines/benchmark.mk THREADS=1 "$@"; }
stages_of() { grep -oE 'target/release/[a-z-]+( (train|eval|embed|masks|lerf|scannet|table))?' "$1" | sed 's|.*/||' | sort | tr '\n' ',' || true; }
synth() { target/release/synth-scene --quiet --features --width 160 --height 120 --boundary-noise 0 --missing 0 --granularity-p 0.2 "$@"; }

lerf=$work/lerf_ovs
for scene in figurines ramen teatime waldo_kitchen; do
  synth --layout lerf-ovs --out "$lerf/$scene" --seed ${#scene} --views 10 --objects 6 --points 1500 &
done
wait
# teatime comes as raw photographs, and the real layout has no truth beside them.
mv "$lerf/figurines/truth/text_features.json" "$work/texts.json"
rm -rf "$lerf/teatime/language_features" "$lerf"/*/truth
scannet=$work/scannet
synth --layout scannet --out "$scannet/scene0000_00" --family room --views 12 --objects 8 --points 6000 &
synth --layout opengaussian --out "$scannet/scene0062_00" --family room --seed 1 --views 12 --objects 8 --points 6000
wait
cp "$scannet/scene0000_00/truth/text_features.json" "$work/names.json"
rm -r "$scannet"/*/truth
# Frames of a recording that are no multiples of 20 are left alone, and so is one without a pose.
cp "$scannet/scene0000_00/color/40.png" "$scannet/scene0000_00/color/47.png"
cp "$scannet/scene0000_00/pose/40.txt" "$scannet/scene0000_00/pose/47.txt"
printf -- '-inf %.0s' {1..16} > "$scannet/scene0000_00/pose/60.txt"
# Data often lies elsewhere, and under other names: folders and files are links.
mkdir "$work/store"
mv "$lerf/figurines" "$work/store/toys"
ln -s ../store/toys "$lerf/figurines"
mv "$lerf/ramen/images" "$work/store/photographs"
cp -rs "$work/store/photographs" "$lerf/ramen/images"
mv "$scannet/scene0000_00" "$work/store/scan"
cp -rs "$work/store/scan" "$scannet/scene0000_00"
mv "$scannet/scene0062_00" "$work/store/converted"
ln -s ../store/converted "$scannet/scene0062_00"
pass "miniatures of LERF-OVS and ScanNet, made of links"

# What make check-data says: nothing where all is there, else what, where, from which page, under which licence.
check() { benchmark check "$@" > "$work/check.log" 2>&1; }
given=(SAM=crates/stages/mask-embed/testdata/sam TEXTS="$work/texts.json")
check SET=lerf-ovs DATA="$lerf" "${given[@]}" CLIP=testdata/clip-tiny || { cat "$work/check.log"; fail "all of LERF-OVS is there"; }
check SET=scannet DATA="$scannet" SCENES="scene0000_00 scene0062_00" TEXTS="$work/names.json" \
  || { cat "$work/check.log"; fail "all of ScanNet is there"; }
said() { # said EXPECTED... SET=... DATA=...: check must fail and say all that is expected before the first NAME=value
  local expected=()
  while [[ $1 != *=* ]]; do expected+=("$1"); shift; done
  ! check "$@" || fail "nothing is missing for: $*"
  for e in "${expected[@]}"; do grep -qF -- "$e" "$work/check.log" || { cat "$work/check.log"; fail "no word of $e"; }; done
}
mkdir "$work/some"
cp -r "$lerf/ramen" "$lerf/label" "$work/some/"
rm "$work/some/label/ramen/frame_00060.json" "$work/some/ramen/sparse/0/points3D.bin" "$work/some/ramen/language_features/frame_00006_f.npy"
said "label/ramen/frame_00060.json" "points3D.bin" "1 of 10 feature files" "$work/some/figurines/images" "minghanqin/LangSplat" Licence \
  SET=lerf-ovs DATA="$work/some" SCENES="ramen figurines" TEXTS="$work/texts.json"
said scene0645_00_vh_clean_2.labels.ply scan-net.org "Terms of Use" TEXTS=file SET=scannet DATA="$work/none"
! make --no-print-directory lerf-ovs DATA="$work/none" OUT="$work/out" > "$work/check.log" 2>&1 || fail "make lerf-ovs without data"
grep -q 'things are missing' "$work/check.log" && [ ! -e "$work/out" ] || { cat "$work/check.log"; fail "make lerf-ovs ran without data"; }
# What is there is read: a label file cut short, a text without a feature, a map of another shape; and what it costs is said.
[ "$(check SET=lerf-ovs DATA="$lerf" SCENES="figurines ramen" "${given[@]}"; grep -c 'forecast at most .* CPU hours .* GB of memory' "$work/check.log")" = 2 ] \
  || { cat "$work/check.log"; fail "no forecast of what a scene costs"; }
grep -q 'ok       frame_[0-9]*_s.npy: 160x120 pixels' "$work/check.log" && grep -q 'ok       labels of 4 frames' "$work/check.log" \
  || { cat "$work/check.log"; fail "masks and labels were not read"; }
cp "$lerf/label/ramen/frame_00060.json" "$work/some/label/ramen/"
cp -rL "$lerf/ramen/sparse" "$lerf/ramen/language_features" "$work/some/ramen/"
head -c 300 "$lerf/label/ramen/frame_00060.json" > "$work/some/label/ramen/frame_00060.json"
said "frame_00060.json: not a label file" "1 things cannot be used" SET=lerf-ovs DATA="$work/some" SCENES=ramen TEXTS="$work/texts.json"
cp "$lerf/label/ramen/frame_00060.json" "$work/some/label/ramen/"
echo '{"egg": [1, 0]}' > "$work/egg.json"
said "texts that will be asked have no feature" SET=lerf-ovs DATA="$work/some" SCENES=ramen TEXTS="$work/egg.json"
maps=("$work/some/ramen/language_features/"*_s.npy)
cp "${maps[0]%_s.npy}_f.npy" "${maps[0]}"
said "${maps[0]##*/}" "1 things cannot be used" SET=lerf-ovs DATA="$work/some" SCENES=ramen TEXTS="$work/texts.json"
! make --no-print-directory lerf-ovs DATA="$work/some" SCENES=ramen OUT="$work/out" TEXTS="$work/texts.json" > "$work/check.log" 2>&1 \
  || fail "make lerf-ovs with a broken map"
[ ! -e "$work/out" ] || fail "make lerf-ovs ran with a broken map"
pass "check-data names what is missing, where it goes, its page and its licence"

small='--iterations 200'
run_lerf() {
  benchmark SET=lerf-ovs DATA="$lerf" OUT="$work/lerf" SCENES="${scenes-figurines ramen teatime waldo_kitchen}" "${given[@]}" \
    GEOM_ARGS="$small --max-gaussians 4000" GRAPH_ARGS='--min-mask-pixels 10' MASK_ARGS='--points-per-side 6' all
}
# The one of raw photographs has the features of another model, and so its texts.
run_raw() {
  make --no-print-directory -f pipelines/lerf-ovs.mk SCENE="$lerf/teatime" OUT="$work/lerf/teatime" THREADS=1 \
    SAM=crates/stages/mask-embed/testdata/sam CLIP=testdata/clip-tiny GEOM_ARGS="$small --max-gaussians 4000" \
    GRAPH_ARGS='--min-mask-pixels 10' MASK_ARGS='--points-per-side 6'
}
run_raw > "$work/raw.log" 2>&1 || { cat "$work/raw.log"; fail "a scene of raw photographs"; }
[ "$(stages_of "$work/raw.log")" = 'cluster-match,cluster-match,eval lerf,feat-train,graph-precompute,gs-geom train,mask-embed embed,mask-embed masks,' ] \
  || fail "a scene of raw photographs ran $(stages_of "$work/raw.log")"
pass "raw photographs of a scene go through SAM and CLIP"
scenes='figurines ramen waldo_kitchen' run_lerf > "$work/lerf.log" 2>&1 || { cat "$work/lerf.log"; fail "make lerf-ovs"; }
target/release/eval table "$work"/lerf/*/protocol --out "$work/lerf" --quiet > /dev/null
for f in table.md table.html metrics.json; do [ -s "$work/lerf/$f" ] || fail "no $f"; done
grep -q '| CAGS | 37.62 |' "$work/lerf/table.md" && grep -q '| VALA |' "$work/lerf/table.md" && grep -q '<td[^>]*>50.79' "$work/lerf/table.html" \
  || fail "the table lacks published rows"
grep -q '"name": "CAGS"' "$work/lerf/metrics.json" || fail "metrics.json lacks published rows"
grep -q 'no training, masks clustering, mixed masks, mixed features, top1' "$work/lerf/table.md" && grep -q 'teatime: there are no masks of LangSplat' "$work/lerf/table.md" \
  && grep -q ', opengaussian\*\*' "$work/lerf/table.md" || fail "the rows do not say how they were made"
! grep -q 'do not compare' "$work/lerf/table.md" || fail "four scenes are said not to be four"
miou=$(grep -F ', top1**' "$work/lerf/table.md" | cut -d'|' -f5 | tr -d ' ')
awk "BEGIN { exit !($miou > 15) }" || fail "figurines has an mIoU of $miou"
scenes='figurines ramen waldo_kitchen' run_lerf > "$work/again.log" 2>&1
[ -z "$(stages_of "$work/again.log")" ] || { cat "$work/again.log"; fail "a second make ran a stage"; }
pass "make lerf-ovs ends in the paper's table (figurines: mIoU $miou), and a second make runs nothing"

benchmark SET=scannet DATA="$scannet" OUT="$work/scan" SCENES="scene0000_00 scene0062_00" TEXTS="$work/names.json" \
  GEOM_ARGS="$small" GRAPH_ARGS='--min-mask-pixels 10' all > "$work/scan.log" 2>&1 \
  || { cat "$work/scan.log"; fail "make scannet"; }
[ "$(wc -l < "$work/scan/scene0000_00/frames/scene0000_00/frames.txt")" = 12 ] || fail "not every 20th frame"
grep -q '| CAGS | 32.60 |' "$work/scan/table.md" && grep -q '| scene0062_00 |' "$work/scan/table.md" || fail "no table of ScanNet"
miou=$(grep -F ', mean over scenes**' "$work/scan/table.md" | cut -d'|' -f3 | tr -d ' ')
awk "BEGIN { exit !($miou > 15) }" || fail "the scans have an mIoU of $miou"
pass "make scannet, extracted and converted, ends in the paper's table (19 classes: mIoU $miou)"

# Without a text the instances alone are scored.
check SET=scannet DATA="$scannet" SCENES=scene0062_00 TEXTS= || { cat "$work/check.log"; fail "ScanNet without texts is refused"; }
grep -q 'only of instances without classes' "$work/check.log" || fail "no word of what is not scored"
benchmark SET=scannet DATA="$scannet" OUT="$work/classless" SCENES=scene0062_00 GEOMETRY="$work/scan/scene0062_00/geometry.ply" \
  GRAPH_ARGS='--min-mask-pixels 10' all > "$work/scan.log" 2>&1 || { cat "$work/scan.log"; fail "make scannet without texts"; }
grep -q '^| Scan | instance mIoU' "$work/classless/table.md" && ! grep -q 'CAGS' "$work/classless/table.md" || fail "no table of instances"
pass "make scannet without texts ends in a table of instances without classes"

scripts/reproduce_check.sh "$work/scan/scene0062_00" "$work/made-again" > "$work/check.log" 2>&1 || { cat "$work/check.log"; fail "reproduce-check"; }
grep -q '^[1-9][0-9]* files are the same bytes, 0 differ' "$work/check.log" || { cat "$work/check.log"; fail "no file was compared"; }
code=0
printf x >> "$work/scan/scene0062_00/graph.safetensors"
scripts/reproduce_check.sh "$work/scan/scene0062_00" "$work/made-again" > "$work/check.log" 2>&1 || code=$?
[ $code = 1 ] && grep -q '^differs: /graph.safetensors' "$work/check.log" || { cat "$work/check.log"; fail "a changed file was not found"; }
pass "reproduce-check: $(sed -n 's/ files.*//p' <(tail -1 "$work/check.log")) files the same, a changed one is named"

echo "$passed passed, 0 failed, $((SECONDS - started)) s; CPU time of all stages: $(times | tail -1)"
