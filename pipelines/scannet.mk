# One scan of ScanNet: make -f pipelines/scannet.mk SCENE=scannet/scene0000_00 OUT=out/scene0000_00. All: make scannet.
#
# A scan as the tools of ScanNet extract it (color/, pose/, intrinsic/) has all frames of the recording; every EVERY-th of
# them is linked to a folder of the same name below OUT. One that OpenGaussian converted (transforms_train.json) has only
# those, and is used as it is.

include pipelines/paths.mk
$(call plain,SCENE)
include pipelines/scannet.conf
PROTOCOL := scannet
ifeq ($(wildcard $(SCENE)/transforms_train.json),)
SOURCE_FILES := $(wildcard $(addprefix $(SCENE)/,color/* pose/* intrinsic/* *.ply *.json))
DATASET := $(OUT)/frames/$(notdir $(SCENE))
SCENE_FILES := $(DATASET)/frames.txt
endif
PROTOCOL_FILES := $(wildcard $(addprefix $(SCENE)/,*.labels.ply *.segs.json *.aggregation.json))
# The scan's vertices stay where they are, photographs have half their size (-r 2), no view is held out. Gaussian i is
# vertex i, and faint ones are left out.
GEOM_FIRST = $(foreach o,densify_fixed resolution_2 holdout_0 iterations_30000,$(call unless,GEOM_ARGS,--$(subst _,$(space),$o)))
GRAPH_FIRST = $(call unless,GRAPH_ARGS,--holdout 0)
include pipelines/protocol.mk

frames_OPTIONS := $(EVERY)
$(OUT)/frames/%/frames.txt: $(SOURCE_FILES) $(OPTIONS)/frames scripts/scannet_frames.sh
	scripts/scannet_frames.sh $(SCENE) $(@D) $(EVERY)
