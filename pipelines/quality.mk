# Points of the trade-offs of docs/performance.md for all stages: QUALITY=fast, balanced or exact.
QUALITY ?= balanced
QUALITY_FILE := $(wildcard pipelines/quality/$(QUALITY).conf)
$(if $(QUALITY_FILE),,$(error no such quality: $(QUALITY); there are $(basename $(notdir $(wildcard pipelines/quality/*.conf)))))
include $(QUALITY_FILE)
