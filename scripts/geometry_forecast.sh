#!/usr/bin/env bash
# geometry_forecast.sh OUT COMMAND...: what a training may take: its memory in MB, as gs-geom itself says at its start for the
# most Gaussians there may be, and its processor time in seconds, by docs/cluster.md. Runs COMMAND (gs-geom train without --out)
# into a temporary folder until it has printed its forecast, stops it, and writes the two numbers to OUT.
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
# 18 iterations per CPU second at 480 x 360 pixels were measured; the time grows with the pixels.
awk -v iterations="$iterations" '
  match($0, /[0-9]+x[0-9]+ pixels/) { split(substr($0, RSTART, RLENGTH), s, /[x ]/); pixels = s[1] * s[2] }
  match($0, /at most [0-9.]+[KMGT]/) {
    word = substr($0, RSTART + 8, RLENGTH - 8)
    unit = index("KMGT", substr(word, length(word)))
    megabytes = int(substr(word, 1, length(word) - 1) * 1024 ^ (unit - 2)) + 1
  }
  END { if (!pixels || !megabytes) exit 1; print megabytes, int(iterations * pixels / (480 * 360 * 18)) + 1 }
' "$folder/said" > "$folder/numbers" || { cat "$folder/said" >&2; echo "geometry_forecast.sh: gs-geom said nothing of its size" >&2; exit 2; }
mv "$folder/numbers" "$out"
