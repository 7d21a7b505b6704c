# `make scene SCENE=folder OUT=folder`: anyone's posed photographs; PHOTOGRAPHS=folder, those without poses. The defaults stand in
# pipelines/custom.conf.
#:  PHOTOGRAPHS=folder  instead of SCENE: photographs without poses, or a video; poses are found first (make poses-env, once)
#:  GEOMETRY=file.spz   use these trained Gaussians instead of training; without SCENE, renders of them instead of photographs
#:  AXES=RDF            where the axes x, y, z of GEOMETRY point [told by the photographs; without SCENE, as its format says]
#:  MASKS=folder        use these id maps (*_s.npy) instead of running SAM
#:  PANOPTIC=folder     a panoptic model beside SAM, which says what its masks show (docs/masks.md)
#:  CONCEPTS=folder     SAM 3 beside SAM, which finds what nouns name (docs/masks.md)
#:  NOUNS=file          those nouns, one a line [VOCABULARY, else about 1,200 everyday ones: slow]
#:  CLIP=folder         image.onnx and text.onnx of a CLIP model [models/clip, if there]; without it no text queries
#:  VOCABULARY=file     names that things may have, one a line [about 1,200 everyday ones]
#:  QUERIES="red_mug …" texts to ask for, with underscores for spaces, without quotes
#:  RESOLUTION=640px    size of the photographs for stage 1: a width that wider ones are shrunk to, a divisor, or auto
#:  QUALITY=balanced    fast, balanced or exact: pipelines/quality
#:  ITERATIONS=1500     steps of stage 1; fast 700, exact 10000
#:  SEED=0              of every stage's random choices
#:  THREADS=0           threads of every stage, 0 for one per core
#:  CONF=file           settings from a file, one NAME = value a line
#: and GEOM_ARGS, VIEW_ARGS, MASK_ARGS, EMBED_ARGS, GRAPH_ARGS, FEAT_ARGS, CLUSTER_ARGS, SCORE_ARGS, REPORT_ARGS: more options of a stage

include pipelines/paths.mk

ifeq ($(SCENE)$(GEOMETRY)$(PHOTOGRAPHS),)
$(error say which photographs or Gaussians: make scene SCENE=folder OUT=folder, or GEOMETRY=file OUT=folder (see make help))
endif
ifneq ($(and $(PHOTOGRAPHS),$(SCENE)$(GEOMETRY)),)
$(error PHOTOGRAPHS is for photographs without poses: leave out SCENE and GEOMETRY, or PHOTOGRAPHS)
endif
ifeq ($(OUT),)
$(error say where to write: make scene SCENE=folder OUT=folder)
endif

include pipelines/custom.conf
include pipelines/quality.mk
include $(CONF)
ifeq ($(SCENE)$(PHOTOGRAPHS),)
ifneq ($(MASKS),)
$(error MASKS=$(MASKS): without SCENE there are no photographs that these masks could be of: leave MASKS out, or give SCENE)
endif
endif
NOUNS ?= $(VOCABULARY)
CLIP ?= $(patsubst %/,%,$(dir $(wildcard models/clip/text.onnx)))

SETTINGS := QUALITY SCENE PHOTOGRAPHS POSES_ARGS GEOMETRY AXES MASKS CLIP SAM PANOPTIC CONCEPTS NOUNS VOCABULARY QUERIES RESOLUTION ITERATIONS SEED \
  GEOM_ARGS VIEW_ARGS MASK_ARGS EMBED_ARGS GRAPH_ARGS FEAT_ARGS CLUSTER_ARGS SCORE_ARGS REPORT_ARGS
include pipelines/settings.mk

ifeq ($(MASKS),)
override MASKS := $(OUT)/masks
MASKS_DONE := $(MASKS)/masks.json
else
MASKS_DONE = $(OPTIONS)/masks.files
endif

# Gaussians of others may have other axes than their format says: the photographs tell, or AXES. Those of a run of ours, in its OUT, are right.
ifneq ($(and $(GEOMETRY),$(SCENE)$(AXES)),)
ifeq ($(if $(call odd,$(GEOMETRY)),,$(wildcard $(dir $(GEOMETRY)).options/geom)),)
SPLAT := $(GEOMETRY)
override GEOMETRY := $(OUT)/given.ply
endif
endif

geom_FROM := RESOLUTION, ITERATIONS or GEOM_ARGS
GEOM_FIRST := --resolution $(RESOLUTION) --iterations $(ITERATIONS) \
  $(if $(filter --refine-poses --refine-poses=%,$(GEOM_ARGS)),,--refine-poses auto)
EVAL_ARGS ?= --resolution $(RESOLUTION)
REPORT_FIRST := --resolution $(RESOLUTION)

# Where the cameras stood is found first (docs/capture.md).
ifneq ($(PHOTOGRAPHS),)
override SCENE := $(OUT)/poses
SCENE_FILES := $(SCENE)/poses.json
endif

# Renders of the Gaussians are the photographs (docs/views.md). None is held out, and to measure the Gaussians on renders of
# themselves would mean nothing.
ifeq ($(SCENE),)
override SCENE := $(OUT)/views
VIEWS_MADE := $(SCENE)/views.json
SCENE_FILES := $(VIEWS_MADE)
METRICS :=
GRAPH_FIRST = $(call unless,GRAPH_ARGS,--holdout 0)
REPORT_FIRST += $(call unless,REPORT_ARGS,--holdout 0)
endif

include pipelines/stages.mk

POSES_PYTHON ?= out/poses-env/bin/python
poses_OPTIONS := $(POSES_ARGS) $(SEED_ARGS)
capture_FILES = find -L $(call arg,PHOTOGRAPHS) -maxdepth 1 -type f -printf '%s %T@ %p\n' | LC_ALL=C sort
$(OUT)/poses/poses.json: $(OPTIONS)/capture.files $(OPTIONS)/poses | $(POSES_PYTHON)
	$(POSES_PYTHON) scripts/poses.py $(call arg,PHOTOGRAPHS) --out $(OUT)/poses $(poses_OPTIONS) $(COMMON)

include pipelines/poses.mk
