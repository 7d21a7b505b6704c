#!/usr/bin/env bash
# check_data.sh SET DATA: what of a data set (lerf-ovs, scannet) is missing in DATA, where it goes, where it comes from and
# under which licence. Of scenes that lack nothing labels, texts and the masks of one photograph are read (eval check), and with
# COST what they may cost is said (gs-geom's forecast, cost_forecast.sh), if the programs in BIN are built. SCENES (a list)
# and the settings MASKS, CLIP, TEXTS, SAM, EVERY, GEOM_ARGS, GRAPH_ARGS, FEAT_ARGS are taken from the environment, as the
# pipelines have them. Exit code 0: all is there; 2: something is missing or wrong. Nothing is downloaded.
set -uo pipefail
set=${1-} data=${2-}
[ -n "$data" ] || { echo "usage: check_data.sh lerf-ovs|scannet DATA (make check-data DATA=folder SET=lerf-ovs|scannet)" >&2; exit 2; }
SCENES=${SCENES-} CLIP=${CLIP-} TEXTS=${TEXTS-} SAM=${SAM-models} EVERY=${EVERY:-20} MASKS=${MASKS-} BIN=${BIN:-target/release}
missing=0 wrong=0 needs= unread=
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
count() { find -L "$1" -maxdepth 1 -type f -name "$2" 2> /dev/null | wc -l; }
lack() { # lack WHAT WHERE SOURCE
  missing=$((missing + 1))
  case " $needs " in *" $3 "*) ;; *) needs+=" $3" ;; esac
  printf '  missing  %s\n           goes to %s   [%s]\n' "$1" "$2" "$3"
}
there() { printf '  ok       %s\n' "$1"; }
# ScanNet's instances are scored without a text, too.
[ "$set" = scannet ] && [ -z "$TEXTS$CLIP" ] && classless=1 || classless=

# Masks and features of the photographs $1 of scene $2: LangSplat's or models to make them with. $3 where they come from.
check_masks() {
  local photographs=$1 folder=${MASKS:-$2/language_features} maps features
  maps=$(count "$folder" '*_s.npy') features=$(count "$folder" '*_f.npy')
  if [ "$maps" -eq 0 ]; then
    printf '  none     masks in %s: SAM makes them\n' "$folder"
    [ -e "$SAM/encoder.onnx" ] || [ -e "$SAM/model.json" ] || lack "SAM's encoder.onnx and sam.onnx" "$SAM (make models), or LangSplat's masks to $folder" sam
    [ -n "$CLIP$classless" ] || lack "a CLIP model for the masks' features" "any folder, given as CLIP=folder" clip
  elif [ "$maps" -lt "$photographs" ]; then
    lack "$((photographs - maps)) of $photographs id maps (*_s.npy)" "$folder" "$3"
  elif [ "$features" -lt "$maps" ] && [ -z "$classless" ]; then
    lack "$((maps - features)) of $maps feature files (*_f.npy)" "$folder" "$3"
  else
    there "$maps id maps, $features with features"
  fi
}
# What texts are encoded with.
check_texts() {
  if [ -n "$TEXTS" ]; then
    if [ -f "$TEXTS" ]; then there "text features $TEXTS"; else lack "the table of text features" "$TEXTS" texts; fi
  elif [ -n "$CLIP" ]; then
    if [ -e "$CLIP/text.onnx" ]; then there "CLIP in $CLIP"; else lack "CLIP's text.onnx" "$CLIP" clip; fi
  elif [ -n "$classless" ]; then
    echo "  note     neither TEXTS nor CLIP: no scores of classes, only of instances without classes   [texts]"
  else
    lack "features of the texts that are asked, of the model that made the masks' features" \
      "any file, given as TEXTS=file, or a CLIP model given as CLIP=folder" texts
  fi
}

check_lerf() {
  local scene=$1 name=${1##*/} frames='' frame labels=$1/label photographs
  case $name in
    figurines) frames='00041 00105 00152 00195' ;;
    ramen) frames='00006 00024 00060 00065 00081 00119 00128' ;;
    teatime) frames='00002 00025 00043 00107 00129 00140' ;;
    waldo_kitchen) frames='00053 00066 00089 00140 00154' ;;
  esac
  photographs=$(find -L "$scene/images" -maxdepth 1 -type f 2> /dev/null | wc -l)
  if [ "$photographs" -gt 0 ]; then there "$photographs photographs"; else lack "photographs (frame_*.jpg)" "$scene/images" lerf-ovs; fi
  for file in cameras images points3D; do
    [ -e "$scene/sparse/0/$file.bin" ] || [ -e "$scene/sparse/0/$file.txt" ] \
      || lack "COLMAP's $file.bin" "$scene/sparse/0" lerf-ovs
  done
  [ -d "$labels" ] || labels=$data/label/$name
  for frame in $frames; do
    [ -e "$labels/frame_$frame.json" ] || lack "labels of frame $frame" "$labels/frame_$frame.json" lerf-ovs
  done
  [ -n "$frames" ] || [ "$(count "$labels" '*.json')" -gt 0 ] || lack "labels (<frame>.json)" "$labels" lerf-ovs
  check_masks "$photographs" "$scene" langsplat-features
}

check_scannet() {
  local scene=$1 name=${1##*/} photographs=0 number lost
  if [ -e "$scene/transforms_train.json" ]; then
    photographs=$(find -L "$scene/color" -maxdepth 1 -type f 2> /dev/null | wc -l)
    if [ "$photographs" -gt 0 ]; then there "$photographs photographs, as OpenGaussian converts them"
    else lack "photographs (<frame>.jpg)" "$scene/color" opengaussian; fi
    [ -e "$scene/points3d.ply" ] || lack "the scan's vertices, points3d.ply" "$scene" opengaussian
  else
    lost=0
    while IFS= read -r number; do
      [[ $number =~ ^[0-9]+$ ]] && ((10#$number % EVERY == 0)) || continue
      photographs=$((photographs + 1))
      [ -e "$scene/pose/$number.txt" ] || lost=$((lost + 1))
    done < <(find -L "$scene/color" -maxdepth 1 -type f -printf '%f\n' 2> /dev/null | sed 's/\.[^.]*$//')
    if [ "$photographs" -gt 0 ]; then there "$photographs photographs (every ${EVERY}th frame)"
    else lack "frames of the recording, $name.sens extracted with its SensReader" "$scene/color, $scene/pose, $scene/intrinsic" scannet; fi
    [ "$lost" -eq 0 ] || lack "$lost of $photographs poses (<frame>.txt)" "$scene/pose" scannet
    [ "$photographs" -eq 0 ] || [ -e "$scene/intrinsic/intrinsic_color.txt" ] || lack "intrinsic_color.txt" "$scene/intrinsic" scannet
    [ -e "$scene/${name}_vh_clean_2.ply" ] || lack "the scan's vertices, ${name}_vh_clean_2.ply" "$scene" scannet
  fi
  [ "$(count "$scene" '*.labels.ply')" -gt 0 ] || lack "the vertices' labels, ${name}_vh_clean_2.labels.ply" "$scene" scannet
  if [ "$(count "$scene" '*_vh_clean_2.0.010000.segs.json')" -eq 0 ] || [ "$(count "$scene" "$name.aggregation.json")" -eq 0 ]; then
    if [ -n "$classless" ]; then
      lack "instances to score without TEXTS or CLIP, ${name}_vh_clean_2.0.010000.segs.json and $name.aggregation.json" "$scene" scannet
    else
      echo "  note     no segs.json with aggregation.json: no scores of instances (the paper's table needs none)   [scannet]"
    fi
  fi
  check_masks "$photographs" "$scene" opengaussian
}

# Reads what is there of scene $1, in folder $2.
check_contents() {
  local line arguments=(--benchmark "$set" --scene "$2") masks=${MASKS:-$2/language_features}
  [ "$(count "$masks" '*_s.npy')" -eq 0 ] || arguments+=(--masks "$masks")
  [ -z "$TEXTS" ] || arguments+=(--text-features "$TEXTS")
  while IFS= read -r line; do
    case $line in
      'eval: error: '*) wrong=$((wrong + 1)) && printf '  wrong    %s\n' "${line#eval: error: }" ;;
      'eval: warning: '*) printf '  note     %s\n' "${line#eval: warning: }" ;;
      *) there "$line" ;;
    esac
  done < <("$BIN/eval" check "${arguments[@]}" 2>&1)
}
# What scene $1 may cost.
say_cost() {
  local photographs=$2 makes=
  [ "$(count "${MASKS:-$2/language_features}" '*_s.npy')" -gt 0 ] || makes=yes
  if [ "$set" = scannet ] && [ ! -e "$2/transforms_train.json" ]; then
    photographs=$scratch/$1
    scripts/scannet_frames.sh "$2" "$photographs" "$EVERY"
  fi
  # The settings of the stages are options with spaces between.
  # shellcheck disable=SC2086
  if scripts/geometry_forecast.sh "$scratch/numbers" "$BIN/gs-geom" train --scene "$photographs" ${GEOM_ARGS-} 2> "$scratch/error"; then
    printf '  forecast %s\n' "$(MAKES_MASKS=$makes scripts/cost_forecast.sh "$scratch/numbers")"
  else
    wrong=$((wrong + 1))
    printf '  wrong    %s\n' "$(tail -2 "$scratch/error" | head -1)"
  fi
}

case $set in lerf-ovs | scannet) ;; *) echo "check_data.sh: SET: found '$set', expected lerf-ovs or scannet" >&2; exit 2 ;; esac
[ -n "$SCENES" ] || { echo "check_data.sh: SCENES is empty" >&2; exit 2; }
[ -d "$data" ] || echo "no such folder yet: $data"
for scene in $SCENES; do
  echo "$scene"
  before=$missing
  check_"${set%-ovs}" "$data/$scene"
  [ "$missing" -eq "$before" ] || continue
  if [ ! -x "$BIN/eval" ] || [ ! -x "$BIN/gs-geom" ]; then unread=yes && continue; fi
  check_contents "$scene" "$data/$scene"
  [ -z "${COST-}" ] || say_cost "$scene" "$data/$scene"
done
echo "texts"
check_texts

[ -z "$unread" ] || echo "not read: what is in the files, because the programs are not built (make build)"
[ "$wrong" -eq 0 ] || printf '\n%d things cannot be used as they are\n' "$wrong"
if [ "$missing" -eq 0 ]; then
  [ "$wrong" -eq 0 ] || exit 2
  echo "all there: $(wc -w <<< "$SCENES") scenes of $set"
  exit 0
fi
echo
echo "$missing things are missing. Where they come from:"
for source in $needs; do
  echo "  [$source]"
  case $source in
    lerf-ovs) echo "    https://github.com/minghanqin/LangSplat (README, Datasets: the expanded LERF data with COLMAP models and labels)
    Licence: the page states none for the data; LangSplat's code is for research and evaluation only. The photographs
    are LERF's (https://www.lerf.io)." ;;
    langsplat-features) echo "    Made by preprocess.py of https://github.com/minghanqin/LangSplat from the photographs (SAM ViT-H, CLIP ViT-B/16
    laion2b_s34b_b88k), or ready from the page of https://github.com/yanmin-wu/OpenGaussian (README, data preparation).
    Licence: as the page says; none is stated for the data. Without them: SAM here (make models) with CLIP=folder." ;;
    scannet) echo "    http://www.scan-net.org, https://github.com/ScanNet/ScanNet: sign the ScanNet Terms of Use, send it in, and use the
    script that the answer brings. Files of a scan: .sens, _vh_clean_2.ply, _vh_clean_2.labels.ply,
    _vh_clean_2.0.010000.segs.json, .aggregation.json. Licence: the ScanNet Terms of Use (research, not commercial)." ;;
    opengaussian) echo "    https://github.com/yanmin-wu/OpenGaussian (README, data preparation: ScanNet as converted, with language_features), or
    its scripts/scannet2blender.py on an extracted scan. Licence: ScanNet's Terms of Use hold for what is made of it." ;;
    sam) echo "    make models (needs npm): MobileSAM. Licence: Apache-2.0." ;;
    clip) echo "    scripts/export_clip.py, of any of open_clip's models (https://github.com/mlfoundations/open_clip); LangSplat's is
    ViT-B-16, laion2b_s34b_b88k. Licence: MIT (code and LAION's weights, on the model's page)." ;;
    texts) echo "    assets/text_features.zip of https://github.com/yanmin-wu/OpenGaussian: the texts of both benchmarks, for features
    of CLIP ViT-B/16 laion2b_s34b_b88k. Licence: that of the repository." ;;
  esac
done
exit 2
