# `make ablation`: the paper's ablation tables, readings of the paper, and our methods on synthetic scenes, one score per
# cell (docs/accuracy.md). What is run stands in PLAN; what its lines mean in crates/stages/eval/src/ablation/plan.rs.
#
# Every cell is a file: a killed make goes on where it was, and a changed line of the plan runs what depends on it. Each
# stage runs on one thread; `make -j` runs as many as there are cores.

include pipelines/paths.mk
PLAN ?= pipelines/ablation.plan
OUT ?= out/ablation
RUNS ?= $(OUT)/runs
DOCS ?=
BIN ?= target/release

.DELETE_ON_ERROR:
.SUFFIXES:
SHELL := /bin/bash
.DEFAULT_GOAL := all

# The plan as variables; its options as files that are touched only when they change.
OPTIONS := $(RUNS)/.options
VARIABLES := $(shell scripts/ablation_plan.sh $(PLAN) $(OPTIONS))
include $(VARIABLES)

COMMON := --threads 1 --quiet
CELLS := $(foreach s,$(SCENES),$(foreach k,$(SEEDS),$s-$k))

# A scene: photographs once, Gaussians once. $1 scene, $2 seed.
define SCENE_RULES
$(RUNS)/$1-$2/scene/truth/scene.json: $(OPTIONS)/scene-$1 | $(BIN)/synth-scene
	$(BIN)/synth-scene --out $(RUNS)/$1-$2/scene $$(scene_$1) --seed $2 $(COMMON)
$(RUNS)/$1-$2/geometry.ply: $(RUNS)/$1-$2/scene/truth/scene.json $(OPTIONS)/geometry | $(BIN)/gs-geom
	$(BIN)/gs-geom train --scene $(RUNS)/$1-$2/scene --out $$@ $$(geometry) $(COMMON)
endef

# Masks of one p, with CLIP-like features. $1 scene, $2 seed, $3 p.
define MASK_RULES
$(RUNS)/$1-$2/p$3/masks/masks.json: $(RUNS)/$1-$2/scene/truth/scene.json $(OPTIONS)/masks | $(BIN)/synth-scene
	$(BIN)/synth-scene --masks-to $$(@D) $$(scene_$1) --seed $2 $$(masks) --granularity-p $3 --features $(COMMON)
endef

# Footprints. $1 scene-seed, $2 p, $3 footprints.
define FOOTPRINT_RULES
$(RUNS)/$1/p$2/$3.graph.safetensors: $(RUNS)/$1/geometry.ply $(RUNS)/$1/p$2/masks/masks.json $(OPTIONS)/footprints-$3 \
  | $(BIN)/graph-precompute
	$(BIN)/graph-precompute --scene $(RUNS)/$1/scene --geometry $(RUNS)/$1/geometry.ply --masks $(RUNS)/$1/p$2/masks \
	  --footprints $(RUNS)/$1/p$2/$3.footprints.safetensors --graph $$@ $$(footprints_$3) $(COMMON)
endef

# Features. $1 scene-seed, $2 p, $3 features, $4 footprints.
define FEATURE_RULES
$(RUNS)/$1/p$2/$3.features.safetensors: $(RUNS)/$1/p$2/$4.graph.safetensors $(OPTIONS)/features-$3 | $(BIN)/feat-train
	$(BIN)/feat-train --geometry $(RUNS)/$1/geometry.ply --graph $$< \
	  --footprints $(RUNS)/$1/p$2/$4.footprints.safetensors --out $$@ $$(features_$3) --checkpoint-every 0 $(COMMON)
endef

# Instances and their score. $1 scene-seed, $2 p, $3 features, $4 footprints, $5 clustering. No coloured PLY is kept.
define SCORE_RULES
$(RUNS)/$1/p$2/$3.$5.instances.safetensors: $(RUNS)/$1/p$2/$3.features.safetensors $(OPTIONS)/clustering-$5 \
  | $(BIN)/cluster-match
	$(BIN)/cluster-match --scene $(RUNS)/$1/scene --geometry $(RUNS)/$1/geometry.ply \
	  --graph $(RUNS)/$1/p$2/$4.graph.safetensors --footprints $(RUNS)/$1/p$2/$4.footprints.safetensors \
	  --features $$< --masks $(RUNS)/$1/p$2/masks --out $$@ $$(clustering_$5) $(COMMON)
	@rm -f $$(basename $$@).ply $$(basename $$@).labels.npy
$(RUNS)/$1/p$2/$3.$5.score.json: $(RUNS)/$1/p$2/$3.$5.instances.safetensors | $(BIN)/eval
	$(BIN)/eval score --scene $(RUNS)/$1/scene --geometry $(RUNS)/$1/geometry.ply --instances $$< --out $$@ \
	  --text-features $(RUNS)/$1/p$2/masks/text_features.json $(COMMON)
endef

# Each rule once, though many rows need it. A row is features.clustering.
unique_rows = $(sort $(foreach t,$(TABLES),$(if $(filter $1,$(table_$t_p)),$(rows_$t))))
unique_features = $(sort $(foreach r,$(call unique_rows,$1),$(word 1,$(subst ., ,$r))))
$(foreach s,$(SCENES),$(foreach k,$(SEEDS),$(eval $(call SCENE_RULES,$s,$k))\
  $(foreach p,$(PS),$(eval $(call MASK_RULES,$s,$k,$p)))))
$(foreach c,$(CELLS),$(foreach p,$(PS),\
  $(foreach f,$(FOOTPRINTS),$(eval $(call FOOTPRINT_RULES,$c,$p,$f)))\
  $(foreach f,$(call unique_features,$p),$(eval $(call FEATURE_RULES,$c,$p,$f,$(features_$f_on))))\
  $(foreach r,$(call unique_rows,$p),$(eval $(call SCORE_RULES,$c,$p,$(word 1,$(subst ., ,$r)),$(features_$(word 1,$(subst ., ,$r))_on),$(word 2,$(subst ., ,$r)))))))

SCORES := $(foreach c,$(CELLS),$(foreach p,$(PS),$(foreach r,$(call unique_rows,$p),$(RUNS)/$c/p$p/$r.score.json)))

.PHONY: all plan
all: $(OUT)/report.html

$(OUT)/report.html: $(SCORES) $(PLAN) $(DOCS) | $(BIN)/eval
	$(BIN)/eval ablation --plan $(PLAN) --runs $(RUNS) --out $(OUT) $(foreach d,$(DOCS),--docs $d) --quiet

plan: # What there is to do
	@echo "$(words $(CELLS)) scenes, p $(PS): $(words $(SCORES)) scores of" \
	  "$(words $(foreach p,$(PS),$(foreach c,$(CELLS),$(call unique_features,$p)))) trainings"

# The programs are built by the top-level Makefile; run alone, this builds what it lacks.
$(BIN)/%:
	cargo build --release --workspace --bins
