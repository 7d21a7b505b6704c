# The DAG: which file is made from which, by which stage. A fragment that includes this sets
#   SCENE       folder of photographs with poses          OUT      folder of everything made
#   SCENE_FILES what the dataset consists of              MASKS    folder of id maps
#   MASKS_DONE  the file that says the id maps are whole  CLIP     folder of a CLIP pair, or empty: no language
# and the options of each stage: GEOM_ARGS, GRAPH_ARGS, FEAT_ARGS, CLUSTER_ARGS, SCORE_ARGS, QUERIES, REPORT_ARGS. It may set
#   PHOTOGRAPHS the data set's folder, where it is not SCENE itself
#   LANGUAGE    the masks' features, where they are there already
#   PROTOCOL    lerf or scannet, to be scored by that; TEXTS, a table of text features instead of CLIP's
#
# Every target is a file that its stage writes whole or not at all, so a killed make goes on where it was. The options of a
# stage are kept in $(OUT)/.options/ and count as one of its inputs: changed options run the stage again, and what follows
# from it. A rebuilt program does not.

.DELETE_ON_ERROR:
.SUFFIXES:
SHELL := /bin/bash

BIN ?= target/release
THREADS ?= 0
SEED ?= 0
COMMON := --threads $(THREADS)
PHOTOGRAPHS ?= $(SCENE)

ifndef QUALITY_FILE
include pipelines/quality.mk
endif

GEOMETRY ?= $(OUT)/geometry.ply
GRAPH := $(OUT)/graph.safetensors
FOOTPRINTS := $(OUT)/footprints.safetensors
FEATURES := $(OUT)/features.safetensors
INSTANCES := $(OUT)/instances.safetensors
OPTIONS := $(OUT)/.options

.DEFAULT_GOAL := all
.PHONY: all FORCE
all: $(OUT)/report.html
ifneq ($(SETTINGS),)
all: settings
endif

# $(OPTIONS)/NAME holds the options of stage NAME and is touched only when they change.
$(OPTIONS)/%: FORCE
	@mkdir -p $(@D)
	@printf '%s\n' '$(subst ','\'',$($*_OPTIONS))' | cmp -s - $@ || { printf '%s\n' '$(subst ','\'',$($*_OPTIONS))' > $@.$$$$ && mv $@.$$$$ $@; }

# The seed counts as an option; 0 is every stage's own.
SEED_ARGS := $(addprefix --seed ,$(filter-out 0,$(SEED)))
geom_OPTIONS ?= $(GEOM_ARGS)
geom_OPTIONS := $(GEOM_QUALITY) $(geom_OPTIONS) $(SEED_ARGS)
graph_OPTIONS := $(GRAPH_QUALITY) $(GRAPH_ARGS) $(SEED_ARGS)
feat_OPTIONS := $(FEAT_QUALITY) $(FEAT_ARGS) $(SEED_ARGS)
cluster_OPTIONS := $(CLUSTER_ARGS) $(SEED_ARGS)
embed_OPTIONS := $(CLIP)
masks_OPTIONS := $(SAM) $(MASK_ARGS)
score_OPTIONS := $(CLIP) $(SCORE_ARGS)
protocol_OPTIONS := $(PROTOCOL) $(CLIP) $(TEXTS) $(SCORE_ARGS)
queries_OPTIONS := $(CLIP) $(QUERIES)
report_OPTIONS ?= $(REPORT_ARGS)

# For pipelines/Snakefile, where each of these is a job of its own.
.PHONY: prepared
prepared: $(SCENE_FILES)
$(OPTIONS)/geometry.forecast: $(SCENE_FILES) scripts/geometry_forecast.sh | $(BIN)/gs-geom
	@mkdir -p $(@D)
	scripts/geometry_forecast.sh $@ $(BIN)/gs-geom train --scene $(PHOTOGRAPHS) $(geom_OPTIONS) $(COMMON)

# Stage 1. Not run when GEOMETRY names a PLY that exists already.
$(OUT)/geometry.ply: $(SCENE_FILES) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(BIN)/gs-geom train --scene $(PHOTOGRAPHS) --out $@ $(geom_OPTIONS) $(COMMON)

$(OUT)/geom_metrics.json: $(GEOMETRY) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(BIN)/gs-geom eval --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --out $@ $(EVAL_ARGS) $(COMMON)

# Stage 0: id maps, where the data set has none.
$(OUT)/masks/masks.json: $(SCENE_FILES) $(OPTIONS)/masks | $(BIN)/mask-embed
	@test -e $(SAM)/encoder.onnx || { echo "no SAM model in $(SAM): run make models, or give MASKS=folder" >&2; exit 2; }
	$(BIN)/mask-embed masks --scene $(PHOTOGRAPHS) --sam $(SAM) --out $(MASKS) $(MASK_ARGS) $(COMMON)

# Stage 0, language half: CLIP features of every mask.
ifneq ($(and $(CLIP),$(if $(LANGUAGE),,none)),)
LANGUAGE := $(MASKS)/features.json
$(LANGUAGE): $(MASKS_DONE) $(OPTIONS)/embed $(wildcard $(CLIP)/*) | $(BIN)/mask-embed
	$(BIN)/mask-embed embed --scene $(PHOTOGRAPHS) --masks $(MASKS) --clip $(CLIP) $(COMMON)
endif

.PHONY: masked
masked: $(MASKS_DONE) $(LANGUAGE)

# Stage 2a writes two files in one run; the second hangs on the first so that `make -j` does not start it twice.
$(GRAPH): $(GEOMETRY) $(MASKS_DONE) $(OPTIONS)/graph | $(BIN)/graph-precompute
	$(BIN)/graph-precompute --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --masks $(MASKS) \
	  --footprints $(FOOTPRINTS) --graph $(GRAPH) $(graph_OPTIONS) $(COMMON)

$(FOOTPRINTS): $(GRAPH)
	@test -e $@ || { echo "$@ is gone: delete $(GRAPH) and run make again" >&2; exit 2; }
	@touch $@

# Stage 2b.
$(FEATURES): $(GEOMETRY) $(GRAPH) $(FOOTPRINTS) $(OPTIONS)/feat | $(BIN)/feat-train
	$(BIN)/feat-train --geometry $(GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) --out $@ $(feat_OPTIONS) $(COMMON)

# Stage 3.
$(INSTANCES): $(FEATURES) $(LANGUAGE) $(OPTIONS)/cluster | $(BIN)/cluster-match
	$(BIN)/cluster-match --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) \
	  --features $(FEATURES) --masks $(MASKS) --out $@ $(cluster_OPTIONS) $(COMMON)

# Stage 4.
$(OUT)/score.json: $(INSTANCES) $(OPTIONS)/score | $(BIN)/eval
	$(BIN)/eval score --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --instances $(INSTANCES) --out $@ \
	  $(if $(CLIP),--clip $(CLIP)) $(SCORE_ARGS) $(COMMON) --quiet

# The same by a published protocol.
$(OUT)/protocol/metrics.json: $(INSTANCES) $(PROTOCOL_FILES) $(OPTIONS)/protocol $(TEXTS) | $(BIN)/eval
	$(BIN)/eval $(PROTOCOL) --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --instances $(INSTANCES) --out $(@D) \
	  $(if $(TEXTS),--text-features $(TEXTS),$(addprefix --clip ,$(CLIP))) $(SCORE_ARGS) $(COMMON) --quiet

# QUERIES is a list of texts with underscores for spaces; without CLIP there is nothing to ask with.
ifneq ($(and $(CLIP),$(QUERIES)),)
QUERY := $(OUT)/query/query.json
space := $(subst ,, )
$(QUERY): $(INSTANCES) $(OPTIONS)/queries | $(BIN)/eval
	$(BIN)/eval query --scene $(PHOTOGRAPHS) --geometry $(GEOMETRY) --instances $(INSTANCES) --clip $(CLIP) --out $(OUT)/query \
	  $(foreach q,$(QUERIES),--text "$(subst _,$(space),$(q))") $(COMMON)
endif

$(OUT)/report.html: $(INSTANCES) $(OUT)/geom_metrics.json $(OUT)/score.json $(QUERY) $(OPTIONS)/report | $(BIN)/eval
	$(BIN)/eval report --scene $(PHOTOGRAPHS) --run-dir $(OUT) --masks $(MASKS) --out $@ $(report_OPTIONS) $(COMMON)

# The programs are built by the top-level Makefile; a fragment that is run alone builds what it lacks.
$(BIN)/%:
	cargo build --release --workspace --bins
