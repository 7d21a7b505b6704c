#!/usr/bin/env bash
# reproduce_check.sh OUT [INTO]: runs what made OUT again with the settings it recorded (settings.conf in OUT, or in the
# folders of its scenes) into INTO (a temporary folder), and compares the bytes of every file that does not say when or how
# fast it was made. Exit code 0: all the same; 1: some differ, which are named; 2: it cannot be run.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1-}
[ -d "$out" ] || { echo "usage: reproduce_check.sh OUT [INTO] (make reproduce-check OUT=folder)" >&2; exit 2; }
out=$(realpath "$out")
if [ -n "${2-}" ]; then
  into=$(realpath -m "$2")
  case $into/ in "$out"/*) echo "reproduce_check.sh: INTO lies in OUT: choose another folder" >&2; exit 2 ;; esac
else
  into=$(mktemp -d)
  trap 'rm -rf "$into"' EXIT
fi
mapfile -t found < <(find -L "$out" -maxdepth 3 -name settings.conf | sort)
[ ${#found[@]} -gt 0 ] || { echo "reproduce_check.sh: no settings.conf in $out: it was made by no pipeline, or is not finished" >&2; exit 2; }

# What says when, where or how fast it was made, and what is left of unfinished runs.
compared() { # compared FOLDER: the files to compare, relative to it
  (cd "$1" && find -L . -type f ! -name '*.run.json' ! -path '*/.options/*' ! -name settings.conf ! -name '*.checkpoint*' \
    ! -name '*.partial*' ! -name report.html ! -path ./metrics.json ! -name '*.log' | sort)
}
different=0 same=0
for settings in "${found[@]}"; do
  run=${settings%/settings.conf}
  name=${run#"$out"}
  to=$into$name
  pipeline='' arguments=()
  while IFS= read -r line; do
    key=${line%% = *} value=${line#* = }
    case $line in
      'PIPELINE = '*) pipeline=$value ;;
      'GEOMETRY = ' | 'MASKS = ') ;; # the run's own
      # A dollar sign is doubled in the file, as make reads it there; on the command line it takes these as they are.
      'SCENE = '* | 'GEOMETRY = '* | 'MASKS = '* | 'CLIP = '* | 'SAM = '* | 'TEXTS = '* | 'QUERIES = '*)
        arguments+=("$key=${value//'$$'/'$'}") ;;
      *) arguments+=("$key=$value") ;;
    esac
  done < "$settings"
  [ -f "$pipeline" ] || { echo "reproduce_check.sh: $settings: no such pipeline: '$pipeline'" >&2; exit 2; }
  echo "== $pipeline ${arguments[*]}"
  mkdir -p "$to"
  make --no-print-directory -f "$pipeline" OUT="$to" ${THREADS:+THREADS="$THREADS"} "${arguments[@]}" > "$to/reproduce.log" 2>&1 \
    || { tail -5 "$to/reproduce.log" >&2; echo "reproduce_check.sh: the run failed; its log is $to/reproduce.log" >&2; trap - EXIT; exit 2; }
  while IFS= read -r file; do
    if [ ! -e "$to/$file" ]; then echo "not made again: $name/${file#./}"; different=$((different + 1))
    elif ! cmp -s "$run/$file" "$to/$file"; then echo "differs: $name/${file#./}"; different=$((different + 1))
    else same=$((same + 1)); fi
  done < <(compared "$run")
  while IFS= read -r file; do
    [ -e "$run/$file" ] || { echo "made only now: $name/${file#./}"; different=$((different + 1)); }
  done < <(compared "$to")
done
echo "$same files are the same bytes, $different differ"
[ "$different" -eq 0 ]
