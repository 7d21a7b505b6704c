#!/usr/bin/env bash
# batch_plan.sh TABLE OUT: the runs of a table of scenes, variants and seeds, one a line of OUT/runs.tsv:
#     name  pipeline  scene  seed  base  target
# and their settings in OUT/<name>/run.conf, files that are touched only when their content changes.
#
# TABLE has a line for each variant, its cells with tabs between: pipeline (custom, lerf-ovs, scannet), scenes (folders, with
# spaces between), variant, seeds (numbers or ranges such as 0-2, with spaces between), settings (NAME=value, with "; "
# between; those of pipelines/<pipeline>.conf). Lines that begin with # are left out. GEOMETRY=@VARIANT uses the Gaussians of
# another variant of the same scene and seed, its base. A run is named <scene>/<variant>-<seed>. {DATA} in scenes and settings is
# DATA of the environment.
set -euo pipefail
table=$1 out=$2
bad() { echo "$table, line $number: $*" >&2; exit 2; }
[ -f "$table" ] || { echo "batch_plan.sh: no such table: $table" >&2; exit 2; }
runs= number=0
# What make and the shell take apart, as in pipelines/paths.mk.
odd=$'$`\'"\\;&|<>(){}[]*?#%:='
[[ $out != *["$odd "]* ]] || { echo "batch_plan.sh: OUT=$out: expected a name without spaces and without any of $odd" >&2; exit 2; }
mkdir -p "$out"
declare -A seen
while IFS= read -r line || [ -n "$line" ]; do
  number=$((number + 1))
  case $line in '' | '#'*) continue ;; *'{DATA}'*) [ -n "${DATA-}" ] || bad "{DATA}: no DATA was given" ;; esac
  line=${line//'{DATA}'/"${DATA-}"}
  IFS=$'\t' read -r pipeline scenes variant seeds settings rest <<< "$line"
  [ -z "${rest-}" ] && [ -n "${seeds-}" ] || bad "expected pipeline, scenes, variant, seeds and settings with tabs between"
  case $pipeline in
    custom) target=report.html ;;
    lerf-ovs | scannet) target=protocol/metrics.json ;;
    *) bad "no pipeline $pipeline: expected custom, lerf-ovs or scannet" ;;
  esac
  [[ $variant =~ ^[A-Za-z0-9._-]+$ ]] || bad "variant $variant: expected letters, digits, dots and dashes"
  numbers=()
  for range in $seeds; do
    [[ $range =~ ^([0-9]+)(-([0-9]+))?$ ]] || bad "seeds $range: expected a number or a range such as 0-2"
    for ((seed = BASH_REMATCH[1]; seed <= ${BASH_REMATCH[3]:-BASH_REMATCH[1]}; seed++)); do numbers+=("$seed"); done
  done
  base= conf=
  while IFS= read -r setting; do
    setting=${setting#"${setting%%[! ]*}"}
    [ -n "$setting" ] || continue
    [[ $setting =~ ^([A-Z_]+)=(.*)$ ]] || bad "setting $setting: expected NAME=value"
    name=${BASH_REMATCH[1]} value=${BASH_REMATCH[2]}
    if [ "$name" = GEOMETRY ] && [[ $value == @* ]]; then base=${value#@}; else conf+="$name = $value"$'\n'; fi
  done <<< "${settings//;/$'\n'}"
  for scene in $scenes; do
    scene=${scene%/}
    [[ $scene != *["$odd"]* && $scene != -* ]] || bad "scene $scene: expected a name without any of $odd"
    for seed in "${numbers[@]}"; do
      run=${scene##*/}/$variant-$seed
      [ -z "${seen[$run]-}" ] || bad "$run is given twice"
      seen[$run]=$pipeline
      of=-
      [ -z "$base" ] || of=${scene##*/}/$base-$seed
      [ "$of" = - ] || [ -n "${seen[$of]-}" ] || bad "GEOMETRY=@$base: no earlier line has the run $of"
      mkdir -p "$out/$run"
      text=$conf
      [ "$of" = - ] || text+="GEOMETRY = $out/$of/geometry.ply"$'\n'
      cmp -s - "$out/$run/run.conf" <<< "$text" || printf '%s\n' "$text" > "$out/$run/run.conf"
      runs+="$run"$'\t'"$pipeline"$'\t'"$scene"$'\t'"$seed"$'\t'"$of"$'\t'"$target"$'\n'
    done
  done
done < "$table"
[ -n "$runs" ] || { echo "$table: no run" >&2; exit 2; }
cmp -s "$out/runs.tsv" <(printf '%s' "$runs") || printf '%s' "$runs" > "$out/runs.tsv"
