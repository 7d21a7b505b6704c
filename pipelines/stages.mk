# The DAG: which file is made from which, by which stage. A fragment that includes this sets
#   SCENE       folder of photographs with poses          OUT      folder of everything made
#   SCENE_FILES what the dataset consists of              MASKS    folder of id maps
#   MASKS_DONE  the file that says the id maps are whole  CLIP     folder of a CLIP pair, or empty: no language
# and the options of each stage: GEOM_ARGS, GRAPH_ARGS, FEAT_ARGS, CLUSTER_ARGS, SCORE_ARGS, QUERIES, REPORT_ARGS.
#
# Every target is a file that its stage writes whole or not at all, so a killed make goes on where it was. The options of a
# stage are kept in $(OUT)/.options/ and count as one of its inputs: changed options run the stage again, and what follows
# from it. A rebuilt program does not.

.DELETE_ON_ERROR:
.SUFFIXES:
SHELL := /bin/bash

BIN ?= target/release
THREADS ?= 0
COMMON := --threads $(THREADS)

GEOMETRY ?= $(OUT)/geometry.ply
GRAPH := $(OUT)/graph.safetensors
FOOTPRINTS := $(OUT)/footprints.safetensors
FEATURES := $(OUT)/features.safetensors
INSTANCES := $(OUT)/instances.safetensors
OPTIONS := $(OUT)/.options

.PHONY: all FORCE
all: $(OUT)/report.html

# $(OPTIONS)/NAME holds the options of stage NAME and is touched only when they change.
$(OPTIONS)/%: FORCE
	@mkdir -p $(@D)
	@printf '%s\n' '$(subst ','\'',$($*_OPTIONS))' | cmp -s - $@ || { printf '%s\n' '$(subst ','\'',$($*_OPTIONS))' > $@.$$$$ && mv $@.$$$$ $@; }

geom_OPTIONS := $(GEOM_ARGS)
graph_OPTIONS := $(GRAPH_ARGS)
feat_OPTIONS := $(FEAT_ARGS)
cluster_OPTIONS := $(CLUSTER_ARGS)
embed_OPTIONS := $(CLIP)
score_OPTIONS := $(CLIP) $(SCORE_ARGS)
queries_OPTIONS := $(CLIP) $(QUERIES)
report_OPTIONS := $(REPORT_ARGS)

# Stage 1. Not run when GEOMETRY names a PLY that exists already.
$(OUT)/geometry.ply: $(SCENE_FILES) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(BIN)/gs-geom train --scene $(SCENE) --out $@ $(GEOM_ARGS) $(COMMON)

$(OUT)/geom_metrics.json: $(GEOMETRY) $(OPTIONS)/geom | $(BIN)/gs-geom
	$(BIN)/gs-geom eval --scene $(SCENE) --geometry $(GEOMETRY) --out $@ $(EVAL_ARGS) $(COMMON)

# Stage 0, language half: CLIP features of every mask.
ifneq ($(CLIP),)
LANGUAGE := $(MASKS)/features.json
$(LANGUAGE): $(MASKS_DONE) $(OPTIONS)/embed $(wildcard $(CLIP)/*) | $(BIN)/mask-embed
	$(BIN)/mask-embed embed --scene $(SCENE) --masks $(MASKS) --clip $(CLIP) $(COMMON)
endif

# Stage 2a writes two files in one run; the second hangs on the first so that `make -j` does not start it twice.
$(GRAPH): $(GEOMETRY) $(MASKS_DONE) $(OPTIONS)/graph | $(BIN)/graph-precompute
	$(BIN)/graph-precompute --scene $(SCENE) --geometry $(GEOMETRY) --masks $(MASKS) \
	  --footprints $(FOOTPRINTS) --graph $(GRAPH) $(GRAPH_ARGS) $(COMMON)

$(FOOTPRINTS): $(GRAPH)
	@test -e $@ || { echo "$@ is gone: delete $(GRAPH) and run make again" >&2; exit 2; }
	@touch $@

# Stage 2b.
$(FEATURES): $(GEOMETRY) $(GRAPH) $(FOOTPRINTS) $(OPTIONS)/feat | $(BIN)/feat-train
	$(BIN)/feat-train --geometry $(GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) --out $@ $(FEAT_ARGS) $(COMMON)

# Stage 3.
$(INSTANCES): $(FEATURES) $(LANGUAGE) $(OPTIONS)/cluster | $(BIN)/cluster-match
	$(BIN)/cluster-match --scene $(SCENE) --geometry $(GEOMETRY) --graph $(GRAPH) --footprints $(FOOTPRINTS) \
	  --features $(FEATURES) --masks $(MASKS) --out $@ $(CLUSTER_ARGS) $(COMMON)

# Stage 4.
$(OUT)/score.json: $(INSTANCES) $(OPTIONS)/score | $(BIN)/eval
	$(BIN)/eval score --scene $(SCENE) --geometry $(GEOMETRY) --instances $(INSTANCES) --out $@ \
	  $(if $(CLIP),--clip $(CLIP)) $(SCORE_ARGS) $(COMMON) --quiet

# QUERIES is a list of texts with underscores for spaces; without CLIP there is nothing to ask with.
ifneq ($(and $(CLIP),$(QUERIES)),)
QUERY := $(OUT)/query/query.json
space := $(subst ,, )
$(QUERY): $(INSTANCES) $(OPTIONS)/queries | $(BIN)/eval
	$(BIN)/eval query --scene $(SCENE) --geometry $(GEOMETRY) --instances $(INSTANCES) --clip $(CLIP) --out $(OUT)/query \
	  $(foreach q,$(QUERIES),--text "$(subst _,$(space),$(q))") $(COMMON)
endif

$(OUT)/report.html: $(INSTANCES) $(OUT)/geom_metrics.json $(OUT)/score.json $(QUERY) $(OPTIONS)/report | $(BIN)/eval
	$(BIN)/eval report --scene $(SCENE) --run-dir $(OUT) --masks $(MASKS) --out $@ $(REPORT_ARGS) $(COMMON)

# The programs are built by the top-level Makefile; a fragment that is run alone builds what it lacks.
$(BIN)/%:
	cargo build --release --workspace --bins
