# The folders and files that people name on the command line, taken as they are: make would expand a $ in them, and a shell
# backticks. Recipes read those that may have any name from the environment, as "$$SCENE". Include this first.

PATHS := SCENE OUT INTO DATA TABLE PLAN CONF MASKS GEOMETRY CLIP SAM PANOPTIC CONCEPTS NOUNS TEXTS VOCABULARY PHOTOGRAPHS

define newline


endef
# Not every shell puts the home folder for the ~ of SCENE=~/photographs.
as_it_is = $(subst $(newline),,$(subst $(newline)~/,$(HOME)/,$(newline)$(value $1)))
$(foreach v,$(PATHS) QUERIES TEXT,\
  $(if $(findstring $(newline),$(value $v)),$(error $v has a line break in it: give it in one line))\
  $(if $(filter command,$(firstword $(origin $v))),$(eval export override $v := $$(call as_it_is,$v)))\
  $(if $(filter environment,$(firstword $(origin $v))),$(eval $v := $$(call as_it_is,$v))))

# What make itself has to hold, as the name of a target or of a file that it reads, is refused where make cannot.
ODD := $$ ` ' " ; & | < > ( ) [ ] { } * ? \# % : \ =
odd = $(strip $(foreach c,$(ODD),$(findstring $c,$1)) $(if $(word 2,x$1x),a space) $(if $(filter -%,$1),a dash in front))
plain = $(if $(call odd,$($1)),$(error $1=$($1): make cannot hold $(call odd,$($1)) in this name: give another, or a link to it (ln -s)))
$(foreach v,OUT INTO DATA TABLE PLAN CONF MASKS,$(call plain,$v))
$(if $(CONF),$(if $(wildcard $(CONF)),,$(error CONF=$(CONF): no such file)))

# Which of them must be there (scripts/check_settings.sh); later ones may be made.
export GIVEN := $(foreach v,SCENE PHOTOGRAPHS GEOMETRY MASKS CLIP PANOPTIC CONCEPTS NOUNS TEXTS VOCABULARY,$(if $($v),$v))
