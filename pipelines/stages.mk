# The DAG: which file is made from which, by which stage. A fragment that includes this has included paths.mk and sets
#   SCENE       folder of photographs with poses          OUT      folder of everything made
#   MASKS       folder of id maps                         CLIP     folder of a CLIP pair, or empty: no language
#   MASKS_DONE  the file that says the id maps are whole
# and the options of each stage: GEOM_ARGS, GRAPH_ARGS, FEAT_ARGS, CLUSTER_ARGS, SCORE_ARGS, QUERIES, REPORT_ARGS. It may set
#   DATASET the data set's folder, where it is not SCENE itself
#   SCENE_FILES what the dataset consists of, where that is not what gs-geom finds in it
#   LANGUAGE    the masks' features, where they are there already
#   SPLAT       Gaussians of others, of which GEOMETRY is made with the right AXES
#   VIEWS_MADE  the file that says that SCENE is whole, where it is made of the Gaussians
#   METRICS     the Gaussians' PSNR and SSIM for the report, or empty
#   VOCABULARY  a file of the names that instances may have, or empty: the everyday ones of eval names
#   PROTOCOL    lerf or scannet, to be scored by that; TEXTS, a table of text features instead of CLIP's
#
# Every target is a file that its stage writes whole or not at all, so a killed make goes on where it was. The options of a
# stage are kept in $(OUT)/.options/ and count as one of its inputs: changed options run the stage again, and what follows
# from it. So is a list of the files that people gave, with sizes and times. A rebuilt program runs nothing again.
#
# Folders and files that people gave may have any name, and no rule names them. OUT and MASKS are in the rules (paths.mk).

.DELETE_ON_ERROR:
.SUFFIXES:
SHELL := /bin/bash

BIN ?= target/release
THREADS ?= 0
SEED ?= 0
COMMON := --threads $(THREADS)
ifneq ($(origin DATASET),file)
DATASET := $(SCENE)
endif

ifndef QUALITY_FILE
include pipelines/quality.mk
endif

OPTIONS := $(OUT)/.options
GRAPH := $(OUT)/graph.safetensors
FOOTPRINTS := $(OUT)/footprints.safetensors
FEATURES := $(OUT)/features.safetensors
# Features are made where something reads them: clustering by them, OpenGaussian's rule of lerf; or where FEAT_ARGS asks for them, to be
# seen in the report and by explore.
CLUSTERED := $(if $(filter graph free --cluster=graph --cluster=free,$(CLUSTER_ARGS)),$(FEATURES))
ASKED := $(if $(filter lerf,$(PROTOCOL)),$(FEATURES))
DRAFT := $(OUT)/draft.safetensors
INSTANCES := $(OUT)/instances.safetensors
SCENE_FILES ?= $(OPTIONS)/scene.files
ifeq ($(GEOMETRY),)
override GEOMETRY := $(OUT)/geometry.ply
GEOMETRY_DONE := $(GEOMETRY)
else ifneq ($(SPLAT),)
GEOMETRY_DONE := $(GEOMETRY)
else
GEOMETRY_DONE := $(OPTIONS)/geometry.files
endif
# The id maps, where SAM makes them.
SAM_MAKES := $(filter $(OUT)/masks/masks.json,$(MASKS_DONE))
export SAM_MAKES SCENE DATASET PHOTOGRAPHS OUT MASKS GEOMETRY SPLAT AXES CLIP SAM PANOPTIC CONCEPTS NOUNS TEXTS VOCABULARY QUERIES SEED THREADS
export POSES_ARGS GEOM_ARGS VIEW_ARGS MASK_ARGS EMBED_ARGS GRAPH_ARGS FEAT_ARGS CLUSTER_ARGS SCORE_ARGS REPORT_ARGS EVAL_ARGS SYNTH_ARGS

.DEFAULT_GOAL := all
.PHONY: all FORCE
all: $(OUT)/report.html
ifneq ($(SETTINGS),)
all: settings
endif

# $(OPTIONS)/NAME holds the options of stage NAME. FORCE runs its recipe every time, but `put` writes the file only when the text
# is another one, so that its time, and all that make decides by it, stays.
put = { cmp -s - $@ <<< "$$text" || { printf '%s\n' "$$text" > $@.$$$$ && mv $@.$$$$ $@; }; }
$(OPTIONS)/%: FORCE | checked-options
	@mkdir -p $(@D)
	@text='$(subst ','\'',$($*_OPTIONS))'; $(put)

# $(OPTIONS)/NAME.files holds names, sizes and times of the files NAME, and is touched only when one of them changes.
$(OPTIONS)/%.files: FORCE | checked-options
	@mkdir -p $(@D)
	@text=$$($($*_FILES)) && $(put)
list = find -L $1 -maxdepth 1 -type f -name $2 -printf '%s %T@ %p\n' | LC_ALL=C sort
scene_FILES = $(BIN)/gs-geom inspect $(call arg,DATASET)
geometry_FILES = $(call list,$(call arg,GEOMETRY),'*')
splat_FILES = $(call list,$(call arg,SPLAT),'*')
# With the names of masks.
masks_FILES = $(call list,$(MASKS)/,'*_s.[nj]*')
# Not the text features that programs keep there.
clip_FILES = $(call list,$(call arg,CLIP)/,'*' ! -name 'cags-texts-*')
panoptic_FILES = find -L $(call arg,PANOPTIC) -type f -printf '%s %T@ %p\n' | LC_ALL=C sort
concepts_FILES = find -L $(call arg,CONCEPTS) $(call arg,NOUNS) -type f -printf '%s %T@ %p\n' | LC_ALL=C sort
texts_FILES = $(call list,$(call arg,TEXTS),'*')
vocabulary_FILES = $(call list,$(call arg,VOCABULARY),'*')

space := $(subst ,, )
# An option with its value, such as --holdout 0, unless people give it in the variable $1.
unless = $(if $(filter $(firstword $2),$($1)),,$2)
# The options of every stage: a fragment's own (GEOM_FIRST, GRAPH_FIRST, REPORT_FIRST), then those of people. The seed counts
# as an option; 0 is every stage's own. A quality is about our own features, not about those of a preset.
SEED_ARGS := $(addprefix --seed ,$(filter-out 0,$(SEED)))
geom_OPTIONS := $(GEOM_QUALITY) $(GEOM_FIRST) $(GEOM_ARGS) $(SEED_ARGS)
splat_OPTIONS := $(AXES)
views_OPTIONS := $(VIEW_ARGS) $(SEED_ARGS)
graph_OPTIONS := $(GRAPH_FIRST) $(GRAPH_ARGS) $(SEED_ARGS)
feat_OPTIONS := $(if $(findstring --preset,$(FEAT_ARGS)),,$(FEAT_QUALITY)) $(FEAT_ARGS) $(SEED_ARGS)
cluster_OPTIONS := $(call unless,CLUSTER_ARGS,$(CLUSTER_QUALITY)) $(CLUSTER_ARGS) $(SEED_ARGS)
embed_OPTIONS := $(CLIP) $(EMBED_ARGS)
masks_ARGS := $(call unless,MASK_ARGS,$(MASK_QUALITY)) $(MASK_ARGS)
masks_OPTIONS := $(SAM) $(PANOPTIC) $(CONCEPTS) $(if $(CONCEPTS),$(NOUNS)) $(masks_ARGS)
score_OPTIONS := $(CLIP) $(SCORE_ARGS)
protocol_OPTIONS := $(PROTOCOL) $(CLIP) $(TEXTS) $(SCORE_ARGS)
queries_OPTIONS := $(CLIP) $(QUERIES)
names_OPTIONS := $(CLIP) $(VOCABULARY)
report_OPTIONS := $(REPORT_FIRST) $(REPORT_ARGS)

# What later stages take for the photographs: with the cameras that stage 1 refined, where it did. Known once that has run: it removes those of
# an earlier run. Masks do not depend on them.
POSED = $(if $(and $(filter $(OUT)/geometry.ply,$(GEOMETRY_DONE)),$(shell test -e $(OUT)/geometry.ply.cameras.json && echo refined)),$(OUT)/geometry.ply.cameras.json,$(DATASET))
export POSED

# What each stage runs. `arg` writes a path out, so that commands can be copied, or as "$NAME" where a shell would take it apart.
arg = $(if $(call odd,$($1)),"$$$1",$($1))
geom_RUN = $(BIN)/gs-geom train --scene $(call arg,DATASET) --out $(OUT)/geometry.ply $(geom_OPTIONS) $(COMMON)
splat_RUN = $(BIN)/gs-geom convert $(call arg,SPLAT) $(GEOMETRY) $(if $(AXES),--axes $(AXES),--scene $(call arg,DATASET)) $(COMMON)
views_RUN = $(BIN)/gs-geom views --geometry $(call arg,GEOMETRY) --out $(SCENE) $(views_OPTIONS) $(COMMON)
metrics_RUN = $(BIN)/gs-geom eval --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --out $(OUT)/geom_metrics.json \
  $(EVAL_ARGS) $(COMMON)
masks_RUN = $(BIN)/mask-embed masks --scene $(call arg,DATASET) --sam $(call arg,SAM) $(if $(PANOPTIC),--panoptic $(call arg,PANOPTIC)) \
  $(if $(CONCEPTS),--concepts $(call arg,CONCEPTS) $(if $(NOUNS),--nouns $(call arg,NOUNS))) --out $(MASKS) $(masks_ARGS) $(COMMON)
embed_RUN = $(BIN)/mask-embed embed --scene $(call arg,DATASET) --masks $(MASKS) --clip $(call arg,CLIP) $(EMBED_ARGS) $(COMMON)
graph_RUN = $(BIN)/graph-precompute --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --masks $(MASKS) \
  --footprints $(FOOTPRINTS) --graph $(GRAPH) $(graph_OPTIONS) $(COMMON)
feat_RUN = $(BIN)/feat-train --geometry $(call arg,GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) --out $(FEATURES) \
  $(feat_OPTIONS) $(COMMON)
cluster_RUN = $(BIN)/cluster-match --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) \
  $(addprefix --features ,$(CLUSTERED)) --masks $(MASKS) --out $(INSTANCES) $(cluster_OPTIONS) $(COMMON)
score_RUN = $(BIN)/eval score --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --instances $(INSTANCES) --out $(OUT)/score.json \
  $(if $(CLIP),--clip $(call arg,CLIP)) $(SCORE_ARGS) $(filter-out --quiet,$(COMMON)) --quiet
protocol_RUN = $(BIN)/eval $(PROTOCOL) --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --instances $(INSTANCES) \
  --out $(OUT)/protocol $(protocol_FIRST) $(if $(TEXTS),--text-features $(call arg,TEXTS),$(if $(CLIP),--clip $(call arg,CLIP))) $(SCORE_ARGS) $(filter-out --quiet,$(COMMON)) --quiet
query_RUN = $(BIN)/eval query --scene $(call arg,POSED) --geometry $(call arg,GEOMETRY) --instances $(INSTANCES) --clip $(call arg,CLIP) \
  --out $(OUT)/query $(foreach q,$(QUERIES),--text '$(subst ','\'',$(subst _,$(space),$q))') $(COMMON)
names_RUN = $(BIN)/eval names --geometry $(call arg,GEOMETRY) --instances $(INSTANCES) $(if $(CLIP),--clip $(call arg,CLIP)) \
  $(if $(VOCABULARY),--vocabulary $(call arg,VOCABULARY)) --out $(OUT)/names.json $(filter-out --quiet,$(COMMON)) --quiet
report_RUN = $(BIN)/eval report --scene $(call arg,POSED) --run-dir $(OUT) --geometry $(call arg,GEOMETRY) --masks $(MASKS) --out $(OUT)/report.html \
  $(report_OPTIONS) $(COMMON)

# Before the first stage runs, every stage checks its options. geom_FROM says in errors where those of stage 1 come from.
PROGRAMS := $(addprefix $(BIN)/,gs-geom mask-embed graph-precompute feat-train cluster-match eval)
geom_FROM ?= GEOM_ARGS
.PHONY: checked-options
checked-options: checked | $(PROGRAMS)
	@scripts/check_options.sh "$(geom_FROM)" $(geom_RUN)
	@$(if $(SPLAT),scripts/check_options.sh AXES $(splat_RUN))
	@$(if $(VIEWS_MADE),scripts/check_options.sh VIEW_ARGS $(views_RUN))
	@scripts/check_options.sh EVAL_ARGS $(metrics_RUN)
	@$(if $(SAM_MAKES),scripts/check_options.sh MASK_ARGS $(masks_RUN))
	@$(if $(filter $(MASKS)/features.json,$(LANGUAGE)),scripts/check_options.sh EMBED_ARGS $(embed_RUN))
	@scripts/check_options.sh GRAPH_ARGS $(graph_RUN)
	@$(if $(CLUSTERED)$(ASKED)$(FEAT_ARGS),scripts/check_options.sh FEAT_ARGS $(feat_RUN))
	@scripts/check_options.sh CLUSTER_ARGS $(cluster_RUN)
	@scripts/check_options.sh SCORE_ARGS $(if $(PROTOCOL),$(protocol_RUN),$(score_RUN))
	@$(if $(QUERY),scripts/check_options.sh QUERIES $(query_RUN))
	@$(if $(NAMES),scripts/check_options.sh VOCABULARY $(names_RUN))
	@scripts/check_options.sh REPORT_ARGS $(report_RUN)

# For pipelines/Snakefile, where each of these is a job of its own.
.PHONY: prepared
prepared: $(SCENE_FILES)
$(OPTIONS)/geometry.forecast: $(SCENE_FILES) scripts/geometry_forecast.sh | $(BIN)/gs-geom
	@mkdir -p $(@D)
	scripts/geometry_forecast.sh $@ $(BIN)/gs-geom train --scene $(call arg,DATASET) $(geom_OPTIONS) $(COMMON)

# Stage 1. Not run when GEOMETRY names a PLY that exists already.
$(OUT)/geometry.ply: $(SCENE_FILES) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(geom_RUN)

# The Gaussians of others, with the axes of the photographs.
ifneq ($(SPLAT),)
$(GEOMETRY): $(if $(AXES),,$(SCENE_FILES)) $(OPTIONS)/splat.files $(OPTIONS)/splat | $(BIN)/gs-geom
	$(splat_RUN)
endif

$(OUT)/geom_metrics.json: $(SCENE_FILES) $(GEOMETRY_DONE) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(metrics_RUN)

# Renders instead of photographs, where there are none.
ifneq ($(VIEWS_MADE),)
$(VIEWS_MADE): $(GEOMETRY_DONE) $(OPTIONS)/views | $(BIN)/gs-geom
	$(views_RUN)
endif

# Stage 0: id maps, where the data set has none.
$(OUT)/masks/masks.json: $(SCENE_FILES) $(OPTIONS)/masks $(if $(PANOPTIC),$(OPTIONS)/panoptic.files) $(if $(CONCEPTS),$(OPTIONS)/concepts.files) | $(BIN)/mask-embed
	$(masks_RUN)

# Stage 3 up to language, and CLIP features of the masks that instances are described by.
ifneq ($(and $(CLIP),$(if $(LANGUAGE),,none)),)
LANGUAGE := $(MASKS)/features.json
cluster_FROM := --from $(DRAFT)
$(DRAFT): $(FOOTPRINTS) $(CLUSTERED) $(OPTIONS)/cluster | $(BIN)/cluster-match
	$(cluster_RUN) --draft $@

$(LANGUAGE): $(DRAFT) $(OPTIONS)/embed $(OPTIONS)/clip.files | $(BIN)/mask-embed
	$(embed_RUN) --only $(DRAFT)
endif

.PHONY: masked
masked: $(MASKS_DONE)

# Stage 2a writes two files in one run; the second hangs on the first so that `make -j` does not start it twice.
$(GRAPH): $(SCENE_FILES) $(GEOMETRY_DONE) $(MASKS_DONE) $(OPTIONS)/graph | $(BIN)/graph-precompute
	$(graph_RUN)

$(FOOTPRINTS): $(GRAPH)
	@test -e $@ || { echo "$@ is gone: delete $(GRAPH) and run make again" >&2; exit 2; }
	@touch $@

# Stage 2b.
$(FEATURES): $(GEOMETRY_DONE) $(GRAPH) $(FOOTPRINTS) $(OPTIONS)/feat | $(BIN)/feat-train
	$(feat_RUN)

# Stage 3.
$(INSTANCES): $(FOOTPRINTS) $(CLUSTERED) $(LANGUAGE) $(OPTIONS)/cluster | $(BIN)/cluster-match
	$(cluster_RUN) $(cluster_FROM)

# Stage 4.
$(OUT)/score.json: $(INSTANCES) $(OPTIONS)/score | $(BIN)/eval
	$(score_RUN)

# The same by a published protocol.
$(OUT)/protocol/metrics.json: $(INSTANCES) $(ASKED) $(PROTOCOL_FILES) $(OPTIONS)/protocol $(if $(TEXTS),$(OPTIONS)/texts.files) | $(BIN)/eval
	$(protocol_RUN)

# QUERIES is a list of texts with underscores for spaces; without CLIP there is nothing to ask with.
ifneq ($(and $(CLIP),$(QUERIES)),)
QUERY := $(OUT)/query/query.json
$(QUERY): $(INSTANCES) $(OPTIONS)/queries | $(BIN)/eval
	$(query_RUN)
endif

# What every instance is called, by a vocabulary or by masks with names: those of a model that is asked, or of a note beside given masks.
NAMED := $(if $(SAM_MAKES),$(PANOPTIC)$(CONCEPTS),$(shell grep -ls '"names"' $(MASKS)/*_s.json | head -n 1))
ifneq ($(CLIP)$(NAMED),)
NAMES := $(OUT)/names.json
$(NAMES): $(INSTANCES) $(OPTIONS)/names $(if $(VOCABULARY),$(OPTIONS)/vocabulary.files) | $(BIN)/eval
	$(names_RUN)
endif

METRICS ?= $(OUT)/geom_metrics.json
$(OUT)/report.html: $(INSTANCES) $(if $(FEAT_ARGS),$(FEATURES)) $(METRICS) $(OUT)/score.json $(NAMES) $(QUERY) $(OPTIONS)/report | $(BIN)/eval
	$(report_RUN)

# The programs are built by the top-level Makefile; a fragment that is run alone builds what it lacks.
$(BIN)/%:
	cargo build --release --workspace --bins
