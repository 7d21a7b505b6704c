#!/usr/bin/env bash
# check_settings.sh: what is wrong with the settings of a pipeline and can be known before anything is built or run, in one line.
# The settings are in the environment; GIVEN names the folders and files that must be there.
set -euo pipefail
bad() { printf '%s\n' "$*" >&2; exit 2; }
for name in ${GIVEN-}; do
  given=${!name}
  [ "$name" != GEOMETRY ] || given=${SPLAT:-$given} # GEOMETRY is made of it then
  case $given in -*) bad "$name=$given: a dash in front looks like an option: write ./$given" ;; esac
  [ -e "$given" ] || bad "$name=$given: no such file or folder"
done
[ ! "${SCENE-}" -ef "${OUT-}" ] || bad "OUT=$OUT: this is SCENE itself: give another folder, such as OUT=${OUT%/}/out"
if [ -n "${SAM_MAKES-}" ] && [ ! -e "$SAM_MAKES" ] && [ ! -e "$SAM/encoder.onnx" ] && [ ! -e "$SAM/model.json" ]; then
  bad "SAM=$SAM: no SAM model in this folder: run make models (or cags models), or give MASKS=folder"
fi
for name in POSES_ARGS GEOM_ARGS VIEW_ARGS MASK_ARGS EMBED_ARGS GRAPH_ARGS FEAT_ARGS CLUSTER_ARGS SCORE_ARGS REPORT_ARGS EVAL_ARGS SYNTH_ARGS; do
  bash -nc ": ${!name-}" 2> /dev/null || bad "$name=${!name}: a shell cannot read this: close every quote and bracket"
done
for name in SEED THREADS; do
  [[ ${!name-0} =~ ^[0-9]+$ ]] || bad "$name=${!name}: expected a number"
done
[[ ${AXES-} =~ ^[A-Za-z]*$ ]] || bad "AXES=$AXES: expected three letters such as RDF"
case " ${QUERIES-} " in
  *\"* | *" '"* | *"' "*) bad "QUERIES=$QUERIES: texts have no quotes around them: write red_mug for \"red mug\"" ;;
esac
