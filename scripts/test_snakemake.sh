#!/usr/bin/env bash
# A batch of two miniature scenes, two variants: the files of `make batch` and of Snakemake's local profile are the same bytes,
# and no job took more memory than was asked for. Skipped where there is no snakemake (make snakemake gets it).
set -euo pipefail
cd "$(dirname "$0")/.."
snakemake=${SNAKEMAKE:-$(command -v out/snakemake/bin/snakemake || command -v snakemake || true)}
if [ -z "$snakemake" ]; then
  echo "skipped: no snakemake (make snakemake puts it into out/snakemake)"
  skip=1
fi
cargo build --release --workspace --bins --tests
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
started=$SECONDS
pass() { printf 'ok: %s (%d s)\n' "$*" $((SECONDS - started)); }
fail() { printf 'FAILED: %s\n' "$*"; exit 1; }

for scene in figurines ramen; do
  target/release/synth-scene --quiet --features --layout lerf-ovs --out "$work/data/$scene" --views 8 --objects 6 --points 1200 \
    --width 160 --height 120 --seed ${#scene} &
done
wait
mv "$work/data/ramen/truth/text_features.json" "$work/texts.json"
scenes="$work/data/figurines $work/data/ramen"
small="GEOM_ARGS=--iterations 100 --max-gaussians 3000; GRAPH_ARGS=--min-mask-pixels 10; TEXTS=$work/texts.json"
printf '# pipeline, scenes, variant, seeds, settings\n%s\t%s\t%s\t%s\t%s\n%s\t%s\t%s\t%s\t%s\n' \
  lerf-ovs "$scenes" spectral 1 "$small" \
  lerf-ovs "$scenes" free 1 "$small; GEOMETRY=@spectral; CLUSTER_ARGS=--cluster free" > "$work/table.tsv"

# Lines that cannot be meant are refused with their number.
refused() {
  local code=0
  printf '%s\n' "$2" > "$work/bad.tsv"
  scripts/batch_plan.sh "$work/bad.tsv" "$work/bad" 2> "$work/error" || code=$?
  [ $code = 2 ] && grep -q "line 1: .*$1" "$work/error" || { cat "$work/error"; fail "a table with $1"; }
}
refused 'no pipeline' $'demo\ta\tb\t0\t'
refused 'seeds' $'custom\ta\tb\tx\t'
refused 'setting' $'custom\ta\tb\t0\titerations 3'
refused 'no earlier line' $'custom\ta\tb\t0\tGEOMETRY=@c'
refused 'given twice' $'custom\ta a\tb\t0\t'
pass "tables that cannot be meant are refused"

batch() { make --no-print-directory -j 2 -f pipelines/batch.mk TABLE="$work/table.tsv" OUT="$work/make"; }
batch > "$work/make.log" 2>&1 || { cat "$work/make.log"; fail "make batch"; }
[ "$(grep -c 'gs-geom train' "$work/make.log")" = 2 ] || { cat "$work/make.log"; fail "not one training for each scene"; }
[ -s "$work/make/tables/free-1/table.md" ] && grep -q '"seed": 1' "$work/make/ramen/spectral-1/geometry.ply.run.json" || fail "no table, or another seed"
batch > "$work/again.log" 2>&1
! grep -q 'target/release/[a-z-]* ' "$work/again.log" || { cat "$work/again.log"; fail "a second make batch ran a stage"; }
pass "make batch: two scenes, two variants, one training each; a second one runs nothing"
[ -z "${skip-}" ] || exit 0

"$snakemake" -s pipelines/Snakefile --profile pipelines/profiles/local --cores 2 --config table="$work/table.tsv" out="$work/snake" \
  threads=1 --directory . > "$work/snake.log" 2>&1 || { tail -40 "$work/snake.log"; fail "snakemake"; }
files=0
while IFS= read -r file; do
  cmp "$work/make/$file" "$work/snake/$file" || fail "$file is not what make made"
  files=$((files + 1))
done < <(cd "$work/make" && find . -type f ! -name '*.run.json' ! -path '*/.options/*' ! -name '*.conf' ! -name runs.tsv | sort)
[ $files -ge 40 ] || fail "only $files files"
pass "snakemake: $files files, the same bytes as make's"

# Each rule's memory, as the log says it, beside the peak that the stage recorded.
if command -v jq > /dev/null; then
  for pair in geometry:geometry.ply graph:graph.safetensors instances:instances.safetensors \
    score:protocol/metrics.json; do
    rule=${pair%%:*} peak=0
    for record in "$work"/snake/*/*/"${pair#*:}".run.json; do
      mb=$(jq '.peak_rss_bytes / 1048576 | ceil' "$record")
      [ "$mb" -le "$peak" ] || peak=$mb
    done
    asked=$(awk -v rule="$rule:" '$1 ~ /rule$/ { now = $2 == rule } now && match($0, /mem_mb=[0-9]+/) { print substr($0, RSTART + 7, RLENGTH - 7) }' "$work/snake.log" | sort -n | head -1)
    [ -n "$asked" ] && [ "$peak" -gt 0 ] || fail "no memory of $rule"
    [ "$peak" -le "$asked" ] || fail "$rule took $peak MB, asked for $asked"
    echo "   $rule: at most $peak MB taken, at least $asked MB asked for"
  done
  pass "no stage took more memory than its rule asks for"
fi
