# Writes $(OUT)/settings.conf: the variables that SETTINGS names with their values, all that a run was asked for besides what
# its data set holds. scripts/reproduce_check.sh gives them again. Include it before any of them is worked on.
#
# The values of a file that CONF names are in it; a dollar sign is doubled, as make reads it.

$(foreach v,$(SETTINGS),$(if $(findstring $(newline),$($v)),$(error $v has a line break in it: give it in one line)))

SEED ?= 0
PIPELINE := $(firstword $(MAKEFILE_LIST))
settings_LINES := 'PIPELINE = $(PIPELINE)' $(foreach v,$(SETTINGS),'$v = $(subst ','\'',$(subst $$,$$$$,$($v)))')

.PHONY: settings checked
# Reading the makefiles has checked what make must hold; this, what can be known before anything is built or run.
checked:
	@scripts/check_settings.sh

settings:
	@mkdir -p $(OUT)
	@printf '%s\n' $(settings_LINES) > $(OUT)/settings.conf
