# `make lerf-ovs DATA=folder OUT=folder`, `make scannet ...`: the scenes of a data set (SET), one after the other or `-j` at a
# time, then the paper's table with ours: OUT/table.md, table.html, metrics.json. A scene is pipelines/$(SET).mk, its
# parameters pipelines/$(SET).conf.

include pipelines/paths.mk
ifeq ($(and $(DATA),$(or $(OUT),$(filter check,$(MAKECMDGOALS)))),)
$(error say where the data set is and where to write: make $(SET) DATA=folder OUT=folder)
endif

.DELETE_ON_ERROR:
.SUFFIXES:
include pipelines/$(SET).conf
include $(CONF)
BIN ?= target/release
METRICS := $(foreach s,$(SCENES),$(OUT)/$s/protocol/metrics.json)

.PHONY: all check read FORCE
export SCENES MASKS CLIP TEXTS SAM EVERY BIN GEOM_ARGS GRAPH_ARGS FEAT_ARGS
check:
	@COST=yes scripts/check_data.sh $(SET) $(DATA)
# The same once the programs are built, before the first scene runs: only they can read what is there.
read: | $(BIN)/eval
	@said=$$(scripts/check_data.sh $(SET) $(DATA) 2>&1) || { echo "$$said" >&2; exit 2; }

.DEFAULT_GOAL := all
all: $(OUT)/metrics.json
	@cat $(OUT)/table.md

$(METRICS): | read
$(OUT)/%/protocol/metrics.json: FORCE
	+@$(MAKE) --no-print-directory -f pipelines/$(SET).mk SCENE=$(DATA)/$* OUT=$(OUT)/$*

# Beside it go table.md and table.html; metrics.json is written last.
$(OUT)/metrics.json: $(METRICS) | $(BIN)/eval
	$(BIN)/eval table $(patsubst %/metrics.json,%,$(METRICS)) --out $(OUT) --quiet > /dev/null

$(BIN)/%:
	cargo build --release --workspace --bins
