# `make granularity`: how much inconsistent granularity costs, on synthetic scenes by a plan (docs/accuracy.md). The rules
# are those of the ablation.

include pipelines/paths.mk
include pipelines/granularity.conf
include $(CONF)
include pipelines/ablation.mk
