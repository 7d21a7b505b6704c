# One scene of LERF-OVS: make -f pipelines/lerf-ovs.mk SCENE=lerf_ovs/ramen OUT=out/ramen. All of them: make lerf-ovs.

include pipelines/paths.mk
$(call plain,SCENE)
include pipelines/lerf-ovs.conf
PROTOCOL := lerf
PROTOCOL_FILES := $(wildcard $(SCENE)/label/*.json $(dir $(SCENE))label/$(notdir $(SCENE))/*.json)
include pipelines/protocol.mk
