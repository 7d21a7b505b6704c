# `make demo`: a synthetic scene with inconsistent granularity, every stage, and answers to text queries. One minute
# on two cores once all is built.

include pipelines/paths.mk
OUT ?= out/demo
SCENE := $(OUT)/scene
$(call plain,SCENE)
SCENE_FILES := $(SCENE)/truth/scene.json
MASKS := $(SCENE)/language_features
MASKS_DONE := $(SCENE_FILES)
CLIP ?= testdata/clip-tiny
# That model knows few words.
VOCABULARY ?= $(if $(filter testdata/clip-tiny,$(CLIP)),testdata/clip-tiny/words.txt)

include $(CONF)
SEED ?= 0
SYNTH_ARGS ?= --seed $(SEED) --objects 10 --views 30 --width 480 --height 360 --granularity-p 0.5
GEOM_FIRST = $(call unless,GEOM_ARGS,--iterations 1000)
GEOM_ARGS ?=
GRAPH_ARGS ?=
FEAT_ARGS ?=
CLUSTER_ARGS ?=
SCORE_ARGS ?=
QUERIES ?= green_kettle pink_coffee_set black_laptop yellow_toy_car
REPORT_ARGS ?=

QUALITY ?= balanced
SETTINGS := QUALITY SEED CLIP VOCABULARY SYNTH_ARGS GEOM_ARGS GRAPH_ARGS FEAT_ARGS CLUSTER_ARGS SCORE_ARGS QUERIES REPORT_ARGS
include pipelines/settings.mk
include pipelines/stages.mk

synth_OPTIONS := $(SYNTH_ARGS)
$(SCENE_FILES): $(OPTIONS)/synth | $(BIN)/synth-scene
	$(BIN)/synth-scene --out $(SCENE) --overwrite $(SYNTH_ARGS) $(COMMON)
