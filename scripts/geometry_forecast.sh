#!/usr/bin/env bash
# geometry_forecast.sh OUT COMMAND...: what a training may take: its memory in MB, as gs-geom itself says at its start for the
# most Gaussians there may be, its processor time in seconds, by docs/cluster.md, that number of Gaussians, and its pixels and
# photographs. Runs COMMAND (gs-geom train without --out) into a temporary folder until it has printed its forecast, stops it, and
# writes the five numbers to OUT.
set -euo pipefail
out=$1
shift
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"$@" --out "$folder/geometry.ply" > "$folder/said" 2>&1 &
training=$!
until grep -q 'memory: ' "$folder/said" || ! kill -0 "$training" 2> "$folder/ended"; do sleep 0.1; done
kill "$training" 2> "$folder/ended" || true
wait "$training" || true
iterations=30000 previous=
for word in "$@"; do
  case $previous in --iterations) iterations=$word ;; esac
  case $word in --iterations=*) iterations=${word#*=} ;; esac
  previous=$word
done
# 18 iterations per CPU second were measured at 480 x 360 pixels and 45,000 Gaussians; the exponents are those of
# docs/performance.md ("Growth"), between the two largest sizes there. A run begins with few Gaussians, so fewer save nothing here.
awk -v iterations="$iterations" '
  match($0, /[0-9]+x[0-9]+ pixels/) { split(substr($0, RSTART, RLENGTH), s, /[x ]/); pixels = s[1] * s[2] }
  match($0, /[0-9]+ training views and [0-9]+ held out/) { split(substr($0, RSTART, RLENGTH), v, " "); views = v[1] + v[5] }
  match($0, /at most [0-9.]+[KMGT] with [0-9]+/) {
    split(substr($0, RSTART, RLENGTH), w, " ")
    gaussians = w[5]
  }
  match($0, /at most [0-9.]+[KMGT]/) {
    word = substr($0, RSTART + 8, RLENGTH - 8)
    unit = index("KMGT", substr(word, length(word)))
    megabytes = int(substr(word, 1, length(word) - 1) * 1024 ^ (unit - 2)) + 1
  }
  END {
    if (!pixels || !megabytes) exit 1
    seconds = iterations / 18 * (pixels / (480 * 360)) ^ 0.63 * (gaussians > 45000 ? (gaussians / 45000) ^ 0.67 : 1)
    print megabytes, int(seconds) + 1, gaussians, pixels, views
  }
' "$folder/said" > "$folder/numbers" || { cat "$folder/said" >&2; echo "geometry_forecast.sh: gs-geom said nothing of its size" >&2; exit 2; }
mv "$folder/numbers" "$out"
