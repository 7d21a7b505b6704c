# What scenes of the benchmarks share: parameters, masks, texts, and the score by the protocol as the last file. The fragment
# that includes this has read its parameters (*.conf) and set PROTOCOL and PROTOCOL_FILES.

ifeq ($(and $(SCENE),$(OUT)),)
$(error say which scene and where to write: SCENE=folder OUT=folder)
endif

include $(CONF)
QUALITY ?= balanced
SETTINGS := QUALITY SCENE GEOMETRY MASKS SAM CLIP TEXTS EVERY SEED GEOM_ARGS MASK_ARGS EMBED_ARGS GRAPH_ARGS FEAT_ARGS CLUSTER_ARGS SCORE_ARGS
include pipelines/settings.mk

# LangSplat's masks and features where they are there; else SAM's, and CLIP's of them.
LANGSPLAT := $(or $(MASKS),$(if $(wildcard $(SCENE)/language_features/*_s.npy),$(SCENE)/language_features))
ifneq ($(LANGSPLAT),)
MASKS := $(LANGSPLAT)
MASKS_DONE = $(OPTIONS)/masks.files
LANGUAGE := $(wildcard $(MASKS)/*_f.npy)
else
override MASKS := $(OUT)/masks
MASKS_DONE := $(MASKS)/masks.json
endif

# The rule of OpenGaussian needs the features; the table then has both rules.
protocol_FIRST = $(addprefix --features ,$(ASKED))

include pipelines/stages.mk

.DEFAULT_GOAL := scored
.PHONY: scored
scored: $(OUT)/protocol/metrics.json settings
