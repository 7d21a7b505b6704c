#!/usr/bin/env bash
# The pipeline as people run it: make, on a tiny synthetic scene. Shows that a second make runs nothing, that a changed
# option runs what depends on it and nothing else, that thread counts and kills do not change a byte, that artifacts of
# different scenes do not mix, and that every stage refuses every damaged input. Takes a minute or two after the build.
set -euo pipefail
cd "$(dirname "$0")/.."
# With the tests, whose dependencies ask more of shared crates: else everything is compiled again after cargo test.
cargo build --release --workspace --bins --tests
# What make would build, without the tests and so with other shared crates, is there.
export CARGO=true

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
passed=0
say() { printf '%s\n' "$*"; }
pass() { passed=$((passed + 1)); say "ok: $*"; }
fail() { say "FAILED: $*"; exit 1; }

# A tiny run of the demo's pipeline into $1 with THREADS=$2; further arguments go to make.
tiny() {
  local out=$1 threads=$2
  shift 2
  make --no-print-directory -f pipelines/demo.mk OUT="$out" THREADS="$threads" \
    SYNTH_ARGS='--seed 7 --objects 8 --views 10 --width 160 --height 120 --granularity-p 0.3' \
    GEOM_ARGS='--iterations 300 --checkpoint-every 40' \
    FEAT_ARGS="${feat:-$feat_default}" GRAPH_ARGS='--min-mask-pixels 10' QUERIES='floor' "$@"
}
feat_default='--preset literal --iterations 300'
artifacts=(scene/sparse/0/cameras.bin scene/sparse/0/images.bin scene/sparse/0/points3D.bin scene/images/frame_00001.png
  scene/truth/points.safetensors scene/truth/scene.json geometry.ply graph.safetensors footprints.safetensors
  features.safetensors instances.safetensors instances.ply)
same() { # are all artifacts of two runs the same bytes?
  local f
  for f in "${artifacts[@]}"; do
    cmp "$1/$f" "$2/$f" || return 1
  done
}
stages_of() { grep -oE 'target/release/[a-z-]+( (train|eval|embed|masks|query|score|names|report))?' "$1" | sed 's|.*/||' | sort | tr '\n' ',' || true; }

say "== a whole run"
tiny "$work/a" 2 > "$work/a.log" 2>&1 || { cat "$work/a.log"; fail "the pipeline"; }
for f in "${artifacts[@]}" report.html metrics.json; do [ -s "$work/a/$f" ] || fail "no $f"; done
pass "the pipeline runs from scene to report"

say "== examples"
if python3 -c 'import numpy' 2> /dev/null; then
  examples/read_artifacts.py "$work/a" > "$work/python.log" && grep -q '^instance ' "$work/python.log" || fail "examples/read_artifacts.py"
  examples/query.py floor "$work/a" > "$work/python.log" && grep -q 'floor: instance' "$work/python.log" || fail "examples/query.py"
  pass "the Python examples read artifacts and ask"
else
  say "skipped: no python3 with numpy"
fi
examples/take_objects.sh "$work/a" "$work/taken" > "$work/export.log" 2>&1 || { cat "$work/export.log"; fail "examples/take_objects.sh"; }
for f in scene.json objects/object_0000.ply meshes/object_0000.obj scene.usda; do [ -s "$work/taken/$f" ] || fail "no $f was taken"; done
pass "a shell example takes objects"
if command -v python3 > /dev/null; then
  examples/simulator_usd.py "$work/taken" | grep -q 'objects can move' && grep -q PhysicsRigidBodyAPI "$work/taken/simulation.usda" || fail "examples/simulator_usd.py"
  examples/blender_objects.py -- "$work/taken" > "$work/python.log" && grep -q 'object_0000.ply' "$work/python.log" || fail "examples/blender_objects.py"
  target/release/explore serve --run-dir "$work/a" --clip testdata/clip-tiny --port 0 2> "$work/serve.log" & server=$!
  for _ in $(seq 100); do url=$(sed -n 's/.*look at \(http[^ ]*\).*/\1/p' "$work/serve.log"); [ -z "$url" ] || break; sleep 0.1; done
  examples/ask_scene.py floor "$url" > "$work/python.log" || { cat "$work/serve.log"; kill $server; fail "examples/ask_scene.py"; }
  kill $server
  grep -q '^size' "$work/python.log" || fail "examples/ask_scene.py answers nothing"
  pass "Python examples make a simulator's stage, read objects for Blender and ask over HTTP"
else
  say "skipped: no python3"
fi

say "== a question in one line"
make -s query OUT="$work/a" TEXT=floor > "$work/query.log" 2>&1 || { cat "$work/query.log"; fail "make query"; }
grep -q -e '--clip ' "$work/query.log" && [ -s "$work/a/asked/query.json" ] || { cat "$work/query.log"; fail "make query answers nothing"; }
! make -s query OUT="$work/a" > "$work/query.log" 2>&1 && grep -q 'say what to look for' "$work/query.log" || fail "make query without TEXT"
pass "make query finds scene, Gaussians, instances and words of a run"

say "== a second make"
tiny "$work/a" 2 > "$work/again.log" 2>&1
[ -z "$(stages_of "$work/again.log")" ] || { cat "$work/again.log"; fail "a second make ran a stage"; }
pass "a second make runs no stage"

say "== one thread"
tiny "$work/b" 1 > "$work/b.log" 2>&1 || { cat "$work/b.log"; fail "the pipeline with one thread"; }
same "$work/a" "$work/b" || fail "one and two threads give different bytes"
pass "one and two threads give the same bytes"

say "== the paper's settings"
for conf in literal paper; do
  features="$(sed -n 's/^FEAT_ARGS = //p' "pipelines/$conf.conf") --iterations 50"
  make --no-print-directory -f pipelines/custom.mk OUT="$work/$conf" THREADS=2 SCENE="$work/a/scene" GEOMETRY="$work/a/geometry.ply" \
    MASKS="$work/a/scene/language_features" CONF="pipelines/$conf.conf" FEAT_ARGS="$features" > "$work/conf.log" 2>&1 \
    || { cat "$work/conf.log"; fail "CONF=pipelines/$conf.conf"; }
  grep -q "\"preset\": *\"$conf\"" "$work/$conf/features.safetensors.run.json" && grep -q '"cluster": *"free"' "$work/$conf/instances.safetensors.run.json" \
    || fail "CONF=pipelines/$conf.conf is not what its stages ran with"
done
pass "literal.conf and paper.conf run"

say "== a changed option"
feat='--preset literal --iterations 310' tiny "$work/b" 1 > "$work/changed.log" 2>&1
ran=$(stages_of "$work/changed.log")
[ "$ran" = 'eval report,feat-train,' ] || fail "a changed feat-train option ran: $ran"
pass "a changed option runs what depends on it and nothing else"

say "== a scene that is not there"
make --no-print-directory scene SCENE="$work/nowhere" OUT="$work/n" > "$work/nowhere.log" 2>&1 && fail "make scene without a scene"
grep -q "SCENE=$work/nowhere: no such" "$work/nowhere.log" && ! grep -q cargo "$work/nowhere.log" || { cat "$work/nowhere.log"; fail "a scene that is not there is not said at once"; }
pass "a scene that is not there is said before anything is built"

say "== Gaussians without photographs"
# Renders take the photographs' place, and a small segmenter by colour that of SAM.
virtual() { # virtual OUT THREADS
  make --no-print-directory -f pipelines/custom.mk GEOMETRY="$work/a/geometry.ply" OUT="$1" THREADS="$2" CLIP= \
    SAM=crates/stages/mask-embed/testdata/sam VIEW_ARGS='--views 6 --size 96x72' MASK_ARGS='--points-per-side 4' \
    GRAPH_ARGS='--min-mask-pixels 4' FEAT_ARGS="$feat_default --levels small"
}
virtual "$work/v" 2 > "$work/v.log" 2>&1 || { cat "$work/v.log"; fail "make scene without photographs"; }
for f in views/sparse/0/images.bin views/images/view_0000.png views/transforms.json views/contact.png views/views.json instances.ply report.html; do
  [ -s "$work/v/$f" ] || fail "no $f of Gaussians without photographs"
done
[ ! -e "$work/v/geom_metrics.json" ] && grep -q 'seen_by_8' "$work/v/views/views.json" || fail "renders were measured against themselves"
virtual "$work/v" 2 > "$work/again.log" 2>&1
[ -z "$(stages_of "$work/again.log")" ] || { cat "$work/again.log"; fail "a second make without photographs ran a stage"; }
virtual "$work/w" 1 > "$work/v.log" 2>&1 || { cat "$work/v.log"; fail "one thread without photographs"; }
for f in views/images/view_0003.png views/sparse/0/images.bin views/views.json instances.safetensors; do
  cmp "$work/v/$f" "$work/w/$f" || fail "without photographs, one and two threads give different bytes"
done
for setting in "MASKS=$work/a/scene/language_features" "VIEW_ARGS=--view 3" "GEOMETRY="; do
  ! make --no-print-directory -f pipelines/custom.mk GEOMETRY="$work/a/geometry.ply" OUT="$work/n" \
    SAM=crates/stages/mask-embed/testdata/sam "$setting" > "$work/said" 2>&1 && grep -qF -- "${setting%%=*}" "$work/said" \
    && [ ! -e "$work/n" ] || { cat "$work/said"; fail "$setting without photographs"; }
done
pass "Gaussians alone become renders, masks and instances"

say "== paths of any name"
# What people name may hold anything but a line break, or is refused by name in one line; nothing in it is ever run.
theirs=$work/a/scene
custom() { make --no-print-directory -f pipelines/custom.mk THREADS=2 MASKS="$theirs/language_features" "$@"; }
said_in_one_line() { # said_in_one_line WORD COMMAND...: it must fail, say one line with WORD besides make's own, and run nothing
  local word=$1 code=0
  shift
  "$@" > "$work/said" 2>&1 || code=$?
  [ "$code" = 2 ] && [ "$(grep -vc '^make' "$work/said")" = 1 ] && grep -qF -- "$word" "$work/said" && [ -z "$(stages_of "$work/said")" ] \
    || { cat "$work/said"; fail "exit code $code, expected one line about $word: $*"; }
}
payload='$(touch was-run)`touch was-run`$(shell touch was-run);touch was-run;'
odd='two  words$HOME$$x'$payload\''"#&|<>()[]{}*?!%:=\~ñ'
ln -s "$theirs" "$work/$odd"
cp "$work/a/geometry.ply" "$work/$odd.ply"
cp -r testdata/clip-tiny "$work/$odd.clip"
any_name() {
  custom OUT="$work/odd" SCENE="$work/$odd" GEOMETRY="$work/$odd.ply" CLIP="$work/$odd.clip" SAM="$odd" \
    GRAPH_ARGS='--min-mask-pixels 10' FEAT_ARGS='--preset literal --iterations 30' QUERIES="floor ${payload// /_}_kid's_toy"
}
any_name > "$work/odd.log" 2>&1 || { cat "$work/odd.log"; fail "paths of any name"; }
grep -q 'axes RDF, as its format says' "$work/odd.log" || { cat "$work/odd.log"; fail "the photographs do not tell the axes of GEOMETRY"; }
[ -s "$work/odd/report.html" ] && [ "$(grep -c '"text"' "$work/odd/query/query.json")" -ge 2 ] || fail "no report of paths of any name"
any_name > "$work/again.log" 2>&1
[ -z "$(stages_of "$work/again.log")" ] || { cat "$work/again.log"; fail "a second make of paths of any name ran a stage"; }
scripts/reproduce_check.sh "$work/odd" > "$work/again.log" 2>&1 || { cat "$work/again.log"; fail "reproduce-check of paths of any name"; }
SCENE="$work/$odd" custom OUT="$work/odd" prepared > "$work/again.log" 2>&1 || { cat "$work/again.log"; fail "a path from the environment"; }
for name in 'a b' 'a[b' 'a]b' 'a(b' 'a)b' "a'b" 'a"b' 'a$b' 'a`b' 'a;b' 'a#b' 'a%b' 'a:b' 'a=b' 'a\b' 'a*b' 'a&b' 'a|b'; do
  ln -s "$theirs" "$work/$name"
  custom OUT="$work/names" SCENE="$work/$name" prepared > "$work/odd.log" 2>&1 && grep -qF "$work/$name/images/" "$work/names/.options/scene.files" \
    || { cat "$work/odd.log"; fail "SCENE=$name"; }
  for setting in OUT MASKS CONF DATA; do
    said_in_one_line "$setting=$work/$name: make cannot hold" make --no-print-directory help "$setting=$work/$name"
  done
done
for setting in OUT MASKS CONF DATA TABLE PLAN INTO; do
  said_in_one_line "$setting=" make --no-print-directory scene SCENE="$theirs" CARGO='touch was-run #' OUT="$work/n" "$setting=$payload"
done
for setting in SCENE GEOMETRY CLIP; do
  said_in_one_line "$setting=" make --no-print-directory scene SCENE="$theirs" CARGO='touch was-run #' OUT="$work/n" "$setting=$payload"
  said_in_one_line "$setting has a line break" make --no-print-directory scene OUT="$work/n" "$setting=$work/"$'a\ntouch was-run'
done
printf 'custom\t%s\tv\t0\t\n' '`touch${IFS}was-run`' > "$work/odd.tsv"
said_in_one_line 'line 1: scene `touch' scripts/batch_plan.sh "$work/odd.tsv" "$work/batch"
[ ! -e was-run ] && [ ! -e "$work/n" ] || { rm -f was-run; fail "part of a name was run, or something was made"; }
(cd "$theirs" && find . -type f -print0 | sort -z | xargs -0 sha256sum) > "$work/before"
ln -s "$theirs" "$work/same"
for same in "$theirs" "$theirs/" "$theirs/." "$work/same"; do
  said_in_one_line "OUT=$same" make --no-print-directory scene CARGO='touch was-run #' SCENE="$theirs" OUT="$same"
done
(cd "$theirs" && find . -type f -print0 | sort -z | xargs -0 sha256sum) | cmp - "$work/before" && [ ! -e was-run ] || fail "OUT=SCENE was not left alone"
pass "paths of any name work or are refused by name in one line, nothing in them is run, and OUT is not SCENE"

say "== options that cannot be meant"
# Every stage looks at its options before the first of them runs.
wrong() { # wrong NAME VALUE WORD [SETTING...]
  said_in_one_line "$3" custom SCENE="$theirs" CLIP=testdata/clip-tiny OUT="$work/wrong" "$1=$2" "${@:4}"
  grep -q "$1" "$work/said" || { cat "$work/said"; fail "no word of $1"; }
}
while IFS='|' read -r name misspelt out_of_range; do
  own=()
  [ "$name" != MASK_ARGS ] || own=(MASKS= SAM=crates/stages/mask-embed/testdata/sam)
  wrong "$name" "${misspelt}" "unexpected argument '${misspelt%% *}'" ${own+"${own[@]}"}
  [ -z "$out_of_range" ] || wrong "$name" "$out_of_range" "${out_of_range%% *}" ${own+"${own[@]}"}
  wrong "$name" "--x 'y" "close every quote" ${own+"${own[@]}"}
done <<'LIST'
GEOM_ARGS|--densif mcmc|--densify-every 0
EVAL_ARGS|--holdou 8|--resolution 0px
MASK_ARGS|--points-per-sid 6|--points-per-side 0
EMBED_ARGS|--corp mean|--crop white
GRAPH_ARGS|--anchor-ration 0.1|--k 0
FEAT_ARGS|--levles small|--layers 5
CLUSTER_ARGS|--jion 0.6|--join 2
SCORE_ARGS|--treshold 0.5|--threshold 3
REPORT_ARGS|--veiws x|
LIST
wrong QUERIES '"red mug' 'no quotes around them'
wrong QUERIES "'red mug' plate" 'no quotes around them'
wrong RESOLUTION 64O 'not a resolution'
wrong SEED x 'expected a number'
wrong SAM "$work/nowhere" 'no SAM model' MASKS=
for setting in PANOPTIC CONCEPTS NOUNS; do wrong $setting "$work/nowhere" 'no such file or folder' MASKS=; done
[ ! -e "$work/wrong/geometry.ply" ] && [ ! -e "$work/wrong/.options" ] || fail "a stage ran with wrong options"
pass "an option that cannot be meant is refused by the name of its setting before a stage runs"

say "== an edited photograph"
# Whatever the dataset's reader finds: folders below images/, input/ beside a COLMAP model, paths of transforms.json.
edited() { # edited SCENE PHOTOGRAPH ANOTHER: stage 1 must run again when PHOTOGRAPH becomes ANOTHER, and not without cause
  local geometry=(custom SCENE="$1" OUT="$1.out" ITERATIONS=2 RESOLUTION=32px "$1.out/geometry.ply")
  for expected in 'gs-geom train,' '' 'gs-geom train,' ''; do
    [ ! -e "$1.second" ] || { cp "$1/$3" "$1/$2" && rm "$1.second"; }
    "${geometry[@]}" > "$work/edited.log" 2>&1 || { cat "$work/edited.log"; fail "$1"; }
    [ "$(stages_of "$work/edited.log")" = "$expected" ] || { cat "$work/edited.log"; fail "$1: expected '$expected'"; }
    [ -n "$expected" ] || touch "$1.second"
  done
}
mkdir "$work/edited"
cp -r "$theirs" "$work/edited/input"
mv "$work/edited/input/images" "$work/edited/input/input"
edited "$work/edited/input" input/frame_00002.png input/frame_00003.png
target/release/synth-scene --quiet --layout opengaussian --size tiny --out "$work/edited/scene0000_00"
for folder in train images/cam0; do
  scene=$work/edited/${folder##*/}
  cp -r "$work/edited/scene0000_00" "$scene"
  mkdir -p "$scene/$(dirname "$folder")" && mv "$scene/color" "$scene/$folder"
  sed -i "s|color/|$folder/|g" "$scene"/transforms_*.json
  mapfile -t names < <(cd "$scene" && find "$folder" -type f | sort)
  edited "$scene" "${names[1]}" "${names[2]}"
done
pass "an edited photograph in images/cam0/, train/ or input/ runs stage 1 again, and nothing else does"

say "== artifacts of another scene"
make --no-print-directory -f pipelines/demo.mk OUT="$work/c" SYNTH_ARGS='--seed 8 --objects 8 --views 6 --width 120 --height 90' \
  GEOM_ARGS='--iterations 30' "$work/c/geometry.ply" > "$work/c.log" 2>&1 || { cat "$work/c.log"; fail "another scene"; }
before=$(sha256sum < "$work/b/features.safetensors")
code=0
target/release/feat-train --geometry "$work/c/geometry.ply" --graph "$work/b/graph.safetensors" \
  --footprints "$work/b/footprints.safetensors" --out "$work/b/features.safetensors" 2> "$work/mixed.log" || code=$?
[ "$code" = 2 ] || fail "mixed artifacts: exit code $code"
[ "$(grep -c 'error:' "$work/mixed.log")" = 1 ] || fail "mixed artifacts: not one line of error"
[ "$before" = "$(sha256sum < "$work/b/features.safetensors")" ] || fail "mixed artifacts: an output was overwritten"
pass "artifacts of another scene are refused: $(grep 'error:' "$work/mixed.log")"

say "== damaged inputs"
# Every stage, every file it reads, every kind of damage: exit code 2, one line that names the file, no output touched.
a=$work/a
scene=$a/scene
masks=$scene/language_features
geometry=(--scene "$scene" --geometry "$a/geometry.ply")
made=(--graph "$a/graph.safetensors" --footprints "$a/footprints.safetensors")
outputs=$work/outputs
refusals=0
refused() { # refused WORD COMMAND...: WORD must be in the one line of error
  local word=$1 code=0
  shift
  (cd "$outputs" && find . -type f -print0 | sort -z | xargs -0 sha256sum) > "$work/before"
  # What stands there is nobody's: it may be given up, and must not be.
  "$@" --quiet --overwrite > /dev/null 2> "$work/error" || code=$?
  (cd "$outputs" && find . -type f -print0 | sort -z | xargs -0 sha256sum) > "$work/after"
  [ "$code" = 2 ] && [ "$(grep -c 'error: ' "$work/error")" = 1 ] && grep -q -- "$word" "$work/error" \
    && ! grep -q panicked "$work/error" && cmp -s "$work/before" "$work/after" \
    || { cat "$work/error"; fail "exit code $code, expected one line about $word and untouched outputs: $*"; }
  refusals=$((refusals + 1))
}
damage() { # damage FILE WORD COMMAND...: the command must refuse FILE cut short, empty, of noise, and missing
  local file=$1 word=$2 size
  shift 2
  size=$(stat -c %s "$file")
  cp "$file" "$work/good"
  head -c $((size / 2)) "$work/good" > "$file" && refused "$word" "$@"
  : > "$file" && refused "$word" "$@"
  { head -c 64 "$work/good" && head -c "$size" /dev/zero | tr '\0' '\377'; } > "$file" && refused "$word" "$@"
  # A scene without points is a scene: training starts at random ones, with a warning.
  case $file in *points3D*) ;; *) rm "$file" && refused "$word" "$@" ;; esac
  cp "$work/good" "$file"
}
fill() { mkdir -p "$outputs" && for f in "$@"; do echo good > "$outputs/$f"; done; }
bin=$PWD/target/release
fill geometry.ply graph.safetensors footprints.safetensors features.safetensors instances.safetensors score.json
train=("$bin/gs-geom" train --scene "$scene" --iterations 3 --out "$outputs/geometry.ply")
for f in cameras images points3D; do damage "$scene/sparse/0/$f.bin" "$f" "${train[@]}"; done
cp "$scene/images/frame_00002.png" "$work/photo"
head -c 1000 "$work/photo" > "$scene/images/frame_00002.png" && refused frame_00002 "${train[@]}"
cp "$work/photo" "$scene/images/frame_00002.png"
precompute=("$bin/graph-precompute" "${geometry[@]}" --masks "$masks" --min-mask-pixels 10
  --graph "$outputs/graph.safetensors" --footprints "$outputs/footprints.safetensors")
damage "$a/geometry.ply" geometry.ply "${precompute[@]}"
for kind in cut noise; do
  cp "$masks/frame_00002_s.npy" "$work/good"
  if [ $kind = cut ]; then head -c 3000 "$work/good"; else tr '\0' '\377' < "$work/good"; fi > "$masks/frame_00002_s.npy"
  refused frame_00002_s.npy "${precompute[@]}"
  cp "$work/good" "$masks/frame_00002_s.npy"
done
features=("$bin/feat-train" --geometry "$a/geometry.ply" "${made[@]}" --out "$outputs/features.safetensors")
damage "$a/geometry.ply" geometry "${features[@]}"
damage "$a/graph.safetensors" graph "${features[@]}"
damage "$a/footprints.safetensors" footprints "${features[@]}"
cluster=("$bin/cluster-match" "${geometry[@]}" "${made[@]}" --features "$a/features.safetensors" --masks "$masks"
  --out "$outputs/instances.safetensors")
damage "$a/geometry.ply" geometry "${cluster[@]}"
damage "$a/graph.safetensors" graph "${cluster[@]}"
damage "$a/footprints.safetensors" footprints "${cluster[@]}"
damage "$a/features.safetensors" features "${cluster[@]}" --cluster free
score=("$bin/eval" score "${geometry[@]}" --instances "$a/instances.safetensors" --out "$outputs/score.json")
damage "$a/geometry.ply" geometry "${score[@]}"
damage "$a/instances.safetensors" instances "${score[@]}"
pass "$refusals damaged inputs were refused in one line each, and no output was touched"

say "== damaged Gaussians"
# Two Gaussians of the geometry lose a number: every stage leaves them out, says so, and goes on.
d=$work/d
mkdir -p "$d"
cp "$a/geometry.ply" "$d/geometry.ply"
start=$(($(grep -abo end_header "$d/geometry.ply" | head -1 | cut -d: -f1) + 11))
row=$((4 * $(head -c "$start" "$d/geometry.ply" | grep -ac '^property float')))
for vertex in 3 20; do
  printf '\000\000\300\177' | dd of="$d/geometry.ply" bs=1 seek=$((start + vertex * row)) conv=notrunc status=none # x = NaN
done
says() { # says COMMAND...: it must succeed and name the damage
  "$@" 2> "$work/said" > /dev/null || { cat "$work/said"; fail "a damaged Gaussian stops $1"; }
  grep -q 'skipped 2 of .* Gaussians: damaged' "$work/said" || { cat "$work/said"; fail "$1 does not say what it left out"; }
}
geometry=(--scene "$scene" --geometry "$d/geometry.ply")
made=(--graph "$d/graph.safetensors" --footprints "$d/footprints.safetensors")
says "$bin/graph-precompute" "${geometry[@]}" --masks "$masks" --min-mask-pixels 10 "${made[@]}"
says "$bin/feat-train" --geometry "$d/geometry.ply" "${made[@]}" --preset literal --iterations 100 --out "$d/features.safetensors"
says "$bin/cluster-match" "${geometry[@]}" "${made[@]}" --features "$d/features.safetensors" --masks "$masks" --out "$d/instances.safetensors"
says "$bin/eval" score "${geometry[@]}" --instances "$d/instances.safetensors" --clip testdata/clip-tiny --out "$d/score.json"
says "$bin/eval" query "${geometry[@]}" --instances "$d/instances.safetensors" --clip testdata/clip-tiny --text floor --out "$d/query"
for vertex in 3 20; do
  label=$(od -An -t d4 -j $((10 + $(od -An -t u2 -j 8 -N 2 "$d/instances.labels.npy") + 4 * vertex)) -N 4 "$d/instances.labels.npy")
  [ $((label)) = -1 ] || fail "the damaged vertex $vertex has the instance $label"
done
pass "graph-precompute, feat-train, cluster-match and eval leave damaged Gaussians out and say so"

say "== kills"
# Kill the whole run at growing moments, then let make finish: the bytes of an undisturbed run.
kills=${KILLS:-12}
seed=${SEED:-1}
RANDOM=$seed
for ((i = 0; i < kills; i++)); do
  moment=$(awk "BEGIN { print 0.15 + $((RANDOM % 1000)) / 1000 * 2.5 }")
  setsid bash -c "$(declare -f tiny); feat_default='$feat_default'; tiny '$work/k' 2" > "$work/k.log" 2>&1 &
  child=$!
  sleep "$moment"
  kill -KILL -- "-$child" 2> /dev/null || true
  wait "$child" 2> /dev/null || true
done
tiny "$work/k" 2 > "$work/k.log" 2>&1 || { cat "$work/k.log"; fail "make after kills"; }
same "$work/a" "$work/k" || fail "kills changed the bytes"
pass "after $kills kills make ends with the bytes of an undisturbed run"

say "== faults"
# The short form of make fault-test: kills, Ctrl-C, full disks, two runs at once, damage and changes, too little memory.
scripts/fault-test --short --seed "$seed" > "$work/faults.log" 2>&1 || { cat "$work/faults.log"; fail "faults"; }
pass "$(tail -1 "$work/faults.log")"

say "== a small ablation"
# One tiny scene, one p, four rows, and the ranges that their results must lie in (pipelines/ablation-small.plan).
ablation() { target/release/bench run "${plan:-pipelines/ablation-small.plan}" --work "$work/ablation/runs" --out "$work/ablation/report.json"; }
ablation > "$work/ablation.log" 2>&1 || { tail -3 "$work/ablation.log"; fail "the small ablation"; }
grep -q 'instance mIoU' "$work/ablation/report.md" && [ -s "$work/ablation/report.html" ] || fail "no tables"
ablation > "$work/again.log" 2>&1
grep -q '^bench: 0 of 14 runs' "$work/again.log" || { cat "$work/again.log"; fail "a second run ran a stage"; }
sed 's/^features spectral .*/& --dim 2/' pipelines/ablation-small.plan > "$work/broken.plan"
plan=$work/broken.plan ablation > "$work/broken.log" 2>&1 && fail "two dimensions are as good as many"
grep -q 'not what the plan expects' "$work/broken.log" || { cat "$work/broken.log"; fail "no word of what was expected"; }
grep -q '^bench: 5 of 14 runs' "$work/broken.log" || { cat "$work/broken.log"; fail "a changed line ran more than its features"; }
pass "the small ablation gives what is expected, and a broken component does not"

say "== the field's systems"
# One tiny scene, two kinds of masks, all systems and ceilings, and the ranges that they must lie in; two of them alone first.
peers() { make --no-print-directory peers PLAN=pipelines/peers-small.plan OUT="$work/peers" JOBS=2 "$@" > "$work/peers.log" 2>&1; }
peers ONLY=labels,opengaussian,saga,laga,pairgs,mask-clustering,mean,dr-splat,vala || { tail -3 "$work/peers.log"; fail "make peers ONLY=systems"; }
python3 -c 'import json, sys; assert len(json.load(open(sys.argv[1]))["systems"]) == 10, "with ours"' "$work/peers/peers.json" || fail "peers.json of some"
peers || { tail -3 "$work/peers.log"; fail "make peers"; }
python3 - "$work/peers/peers.json" <<'PY' || fail "peers.json lacks figures"
import json, sys
systems = json.load(open(sys.argv[1]))["systems"]
assert len(systems) == 15, len(systems)
for s in systems:
    for masks in ("0.5", "sam"):
        found = s["masks"][masks]
        assert found["query_miou"] is not None and found["peak_rss_bytes"] > 0 and found["seconds"] is not None, (s["system"], found)
PY
pass "eleven systems of the field run beside ours"

say "== benchmarks"
# The harness of make bench and make stress on a small part of their work.
cat > "$work/tradeoffs.plan" <<'PLAN'
scene tiny | --size tiny --views 10 --objects 5 | --iterations 120 --max-gaussians 3000
repeats | 1
knob cut | graph | Smallest share
point cut | 0 | --cut 0 | exact default
point cut | all but nothing | --cut 0.2 |
axis views | Photographs | graph
size views | 6  | --size tiny --views 6  | --iterations 20
size views | 12 | --size tiny --views 12 | --iterations 20
PLAN
bench() { target/release/bench "$@" --quiet > "$work/bench.log" 2>&1 || { cat "$work/bench.log"; fail "bench $1"; }; }
bench run "$work/tradeoffs.plan" --work "$work/trade" --out "$work/trade.json"
grep -q 'all but nothing' "$work/trade.md" && grep -q 'Growth' "$work/trade.md" && [ -s "$work/trade.html" ] || fail "no trade-offs"
# What keeps a fifth of a mask or nothing must lose something: the harness measures what it says.
awk -F'|' '/all but nothing/ { found = $6 + 0 > 1 } END { exit !found }' "$work/trade.md" || fail "a coarse cut lost nothing"
bench stress --only "metamorphic scaled" --work "$work/stress" --out "$work/stress.json"
grep -q '"good": true' "$work/stress.json" || fail "no stress"
pass "the harness of make bench and make stress measures what it says"

# Nothing is better than the truth: not what the stages found, nor its masks grouped by it.
tiny=$work/trade/tiny base=$work/trade/tiny/exact
bench ceilings --scene "$tiny/scene" --geometry "$tiny/geometry.ply" --footprints "$base/footprints.safetensors" --out "$work/ceilings.json"
reached() {
  target/release/eval score --scene "$tiny/scene" --geometry "$tiny/geometry.ply" --instances "$1" --out "$work/reached.json" \
    2> "$work/reached.log" | awk '$1 == "instance_miou" { print $2 }'
}
best=$(reached "$work/ceilings.true-labels.safetensors")
for instances in "$base/instances.safetensors" "$work/ceilings.large.safetensors"; do
  awk -v best="$best" -v other="$(reached "$instances")" 'BEGIN { exit !(other > 0 && best >= other) }' || fail "better than the truth: $instances"
done
pass "no instances are better than the ceilings of bench"

say "== handheld captures"
hand=$work/hand
seen() { # scene $1 of family $2 and seed $3, with further options
  target/release/synth-scene --out "$hand/$1" --family "$2" --seed "$3" --views 24 --width 320 --height 240 --quiet "${@:4}" > /dev/null
}
seen exact kitchen 33
seen noisy kitchen 33 --pose-noise 1
# Plain walls behind a table are the hard case without points.
seen table table 52
for scene in exact table; do
  cp -r "$hand/$scene" "$hand/$scene-bare" && rm "$hand/$scene-bare/sparse/0/points3D.bin"
done
quality() { # held-out PSNR of scene $1, with further options
  local scene=$hand/$1
  shift
  target/release/gs-geom train --scene "$scene" --out "$scene.ply" --iterations 500 --quiet "$@" > "$work/hand.log" 2>&1 \
    || { cat "$work/hand.log"; fail "geometry of $scene"; }
  grep -oE '"psnr_heldout": *[0-9.]+' "$scene.ply.run.json" | grep -oE '[0-9.]+$'
}
parted() { # instance mIoU of dataset $2 on the geometry of scene $1
  local own=$hand/$1 masks=$hand/$1/language_features
  target/release/graph-precompute --scene "$2" --geometry "$own.ply" --masks "$masks" --graph "$own.graph" --footprints "$own.prints" --quiet
  local inputs=(--geometry "$own.ply" --graph "$own.graph" --footprints "$own.prints" --quiet)
  target/release/cluster-match --scene "$2" "${inputs[@]}" --masks "$masks" --out "$own.instances.safetensors"
  target/release/eval score --scene "$2" --geometry "$own.ply" --instances "$own.instances.safetensors" --out "$own.score" 2>&1 \
    | awk '$1 == "instance_miou" { print $2 }'
}
near() { # fails with text $4 where $1 is not above $2 less $3
  awk "BEGIN { exit !($1 > $2 - $3) }" || fail "$4 $1, for $2"
}
exact=$(quality exact) bare=$(quality exact-bare) noisy=$(quality noisy --refine-poses)
near "$bare" "$exact" 1 "without points, in dB:"
near "$noisy" "$exact" 1 "refined poses, in dB:"
table=$(quality table) bare_table=$(quality table-bare)
near "$bare_table" "$table" 1 "a table without points, in dB:"
whole=$(parted exact "$hand/exact") refined=$(parted noisy "$hand/noisy.ply.cameras.json")
near "$refined" "$whole" 0.05 "instances with refined poses:"
pass "without points ($bare dB) or exact poses ($noisy dB, instances $refined) a scene is as good as with them ($exact dB, $whole)"

say "$passed passed, 0 failed"
