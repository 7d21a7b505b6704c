#!/usr/bin/env bash
# ablation_plan.sh PLAN DIR: the plan of an ablation as variables of make, in DIR/plan.mk, whose name it prints; and the
# options of each line in DIR/KEYWORD-NAME, files that are touched only when their content changes.
set -euo pipefail
plan=$1 dir=$2
mkdir -p "$dir"
put() { cmp -s - "$dir/$1" <<< "$2" || printf '%s\n' "$2" > "$dir/$1"; }
trim() { local s=$1; s=${s#"${s%%[![:space:]]*}"}; printf '%s' "${s%"${s##*[![:space:]]}"}"; }
variables=
say() { variables+="$1"$'\n'; }
while IFS= read -r line || [ -n "$line" ]; do
  case $line in '' | '#'*) continue ;; esac
  IFS='|' read -r head a b c _ <<< "$line"
  read -r keyword name _ <<< "$head"
  a=$(trim "${a-}") b=$(trim "${b-}")
  case $keyword in
    seeds) say "SEEDS := $a" ;;
    geometry | masks) say "$keyword := $a"; put "$keyword" "$a" ;;
    scene) say "SCENES += $name"; say "scene_$name := $a"; put "scene-$name" "$a" ;;
    footprints) say "FOOTPRINTS += $name"; say "footprints_$name := $a"; put "footprints-$name" "$a" ;;
    features) say "features_$name := $b"; say "features_${name}_on := $a"; put "features-$name" "$a $b" ;;
    clustering) say "clustering_$name := $a"; put "clustering-$name" "$a" ;;
    table) say "TABLES += $name"; say "table_${name}_p := $a"; say "PS := \$(sort \$(PS) $a)" ;;
    row) say "rows_$name += $a.$b" ;;
  esac
done < "$plan"
put plan.mk "$variables"
echo "$dir/plan.mk"
