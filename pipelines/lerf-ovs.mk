# One scene of LERF-OVS: make -f pipelines/lerf-ovs.mk SCENE=lerf_ovs/ramen OUT=out/ramen. All of them: make lerf-ovs.

include pipelines/paths.mk
$(call plain,SCENE)
include pipelines/lerf-ovs.conf
PROTOCOL := lerf
PROTOCOL_FILES := $(wildcard $(SCENE)/label/*.json $(dir $(SCENE))label/$(notdir $(SCENE))/*.json)
# 3DGS on the photographs at their own size (at most 1600 wide), every eighth one held out. The selection is rendered alone
# above 0.7, and the mean is over pairs of frame and category.
GEOM_FIRST = $(call unless,GEOM_ARGS,--iterations 30000)
include pipelines/protocol.mk
