# `make batch TABLE=file OUT=folder`: scenes x variants x seeds from one table (scripts/batch_plan.sh says what it holds), -j
# runs at a time. Scenes of a benchmark end in the paper's table for each variant and seed, OUT/tables/<variant>-<seed>, and
# in OUT/summary.md.
#
# Each run is a make of its own on pipelines/<pipeline>.mk, so a killed batch goes on where it was, and a changed line of the
# table runs what depends on it. pipelines/Snakefile is the same for more than one machine.

include pipelines/paths.mk
TABLE ?=
OUT ?= out/batch
BIN ?= target/release
ifeq ($(TABLE),)
$(error say which table: make batch TABLE=file OUT=folder)
endif

.DELETE_ON_ERROR:
.SUFFIXES:
SHELL := /bin/bash
.DEFAULT_GOAL := all

$(if $(filter 0,$(shell DATA='$(DATA)' scripts/batch_plan.sh $(TABLE) $(OUT); echo $$?)),,$(error the table cannot be read))
# A run as name|pipeline|scene|seed|base|target.
LINES := $(shell tr '\t' '|' < $(OUT)/runs.tsv)
cell = $(word $2,$(subst |, ,$1))

.PHONY: all FORCE
THREADS ?= 1
RUN = +@$(MAKE) --no-print-directory THREADS=$(THREADS) BIN=$(BIN)

# $1 a run. The Gaussians first: other runs may want them.
define RUN_RULES
$(OUT)/$(call cell,$1,1)/geometry.ply: FORCE
	$$(RUN) -f pipelines/$(call cell,$1,2).mk SCENE=$(call cell,$1,3) SEED=$(call cell,$1,4) OUT=$$(@D) CONF=$$(@D)/run.conf $$@
$(OUT)/$(call cell,$1,1)/$(call cell,$1,6): FORCE | $(OUT)/$(if $(filter -,$(call cell,$1,5)),$(call cell,$1,1),$(call cell,$1,5))/geometry.ply
	$$(RUN) -f pipelines/$(call cell,$1,2).mk SCENE=$(call cell,$1,3) SEED=$(call cell,$1,4) OUT=$(OUT)/$(call cell,$1,1) CONF=$(OUT)/$(call cell,$1,1)/run.conf
all: $(OUT)/$(call cell,$1,1)/$(call cell,$1,6)
endef
$(foreach r,$(LINES),$(eval $(call RUN_RULES,$r)))

# The scenes of a benchmark by variant and seed.
SCORED := $(foreach r,$(filter %|protocol/metrics.json,$(LINES)),$(call cell,$r,1))
VARIANTS := $(sort $(notdir $(SCORED)))
define TABLE_RULES
$(OUT)/tables/$1/metrics.json: $(foreach r,$(filter %/$1,$(SCORED)),$(OUT)/$r/protocol/metrics.json) | $(BIN)/eval
	$(BIN)/eval table $(foreach r,$(filter %/$1,$(SCORED)),$(OUT)/$r/protocol) --out $$(@D) --quiet > /dev/null
endef
$(foreach v,$(VARIANTS),$(eval $(call TABLE_RULES,$v)))

# Our rows of all of them below each other.
ifneq ($(VARIANTS),)
all: $(OUT)/summary.md
$(OUT)/summary.md: $(foreach v,$(VARIANTS),$(OUT)/tables/$v/metrics.json) scripts/batch_summary.sh
	scripts/batch_summary.sh $(OUT)/tables > $@
endif

$(BIN)/%:
	cargo build --release --workspace --bins
