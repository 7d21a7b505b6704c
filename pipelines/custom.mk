# `make scene SCENE=folder OUT=folder`: anyone's posed photographs.
#:  GEOMETRY=file.ply   use these trained Gaussians instead of training
#:  MASKS=folder        use these id maps (*_s.npy) instead of running SAM
#:  CLIP=folder         image.onnx and text.onnx of a CLIP model [models/clip, if there]; without it no text queries
#:  QUERIES="red_mug …" texts to ask for, with underscores for spaces
#:  RESOLUTION=640px    size of the photographs for stage 1: a width that wider ones are shrunk to, or a divisor
#:  ITERATIONS=3000     steps of stage 1
#:  THREADS=0           threads of every stage, 0 for one per core
#: and GEOM_ARGS, MASK_ARGS, GRAPH_ARGS, FEAT_ARGS, CLUSTER_ARGS, REPORT_ARGS: more options of a stage

ifeq ($(SCENE),)
$(error say which photographs: make scene SCENE=folder OUT=folder (see make help))
endif
ifeq ($(OUT),)
$(error say where to write: make scene SCENE=folder OUT=folder)
endif

SCENE_FILES := $(wildcard $(addprefix $(SCENE)/,sparse/0/* sparse/* images/* transforms*.json color/* pose/* *.ply))
RESOLUTION ?= 640px
ITERATIONS ?= 3000
CLIP ?= $(patsubst %/,%,$(dir $(wildcard models/clip/text.onnx)))
SAM ?= models

ifeq ($(MASKS),)
MASKS := $(OUT)/masks
MASKS_DONE := $(MASKS)/masks.json
else
MASKS_DONE := $(wildcard $(MASKS)/*_s.npy)
endif

override GEOM_ARGS := --resolution $(RESOLUTION) --iterations $(ITERATIONS) $(GEOM_ARGS)
EVAL_ARGS ?= --resolution $(RESOLUTION)
REPORT_ARGS ?= --resolution $(RESOLUTION)

include pipelines/stages.mk

masks_OPTIONS := $(SAM) $(MASK_ARGS)
$(OUT)/masks/masks.json: $(SCENE_FILES) $(OPTIONS)/masks | $(BIN)/mask-embed
	@test -e $(SAM)/encoder.onnx || { echo "no SAM model in $(SAM): run make models, or give MASKS=folder" >&2; exit 2; }
	$(BIN)/mask-embed masks --scene $(SCENE) --sam $(SAM) --out $(MASKS) $(MASK_ARGS) $(COMMON)
