# One environment in .venv, made when it is missing or when pyproject.toml or constraints.txt change.
#
#   make setup PYTHON=python3.12     another Python, 3.11 or newer
#   make setup EXTRAS=ros,dev        without torch; give the same EXTRAS to the other targets
#   make test PYTEST_ARGS="-n 0 -x"  any pytest arguments (by default, all cores)

PYTHON ?= python3
EXTRAS ?= ros,learn,ray,dev
PYTEST_ARGS ?= -n auto

VENV := .venv
BIN := $(VENV)/bin
comma := ,
READY := $(VENV)/.ready-$(subst $(comma),-,$(EXTRAS))

.DEFAULT_GOAL := help
.PHONY: help setup test lint format demo demo-entry benchmark clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY) ## create .venv and install everything into it

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and \
	    "DSCP needs Python 3.11 or newer, $(PYTHON) is %d.%d: try make setup PYTHON=python3.11" % v[:2])'
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot create environments: on Debian and Ubuntu, install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --no-input \
	    --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

test: $(READY) ## run all tests
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(READY) ## check format, style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(READY) ## format the code, fix what can be fixed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

demo: $(READY) ## replay descents into the planner node, tune, reload; fly a campaign; results in out/demo
	$(BIN)/python -m dscp_ros.demo --output out/demo
	$(BIN)/python -m dscp_ros.demo --loop --output out/demo/loop
	$(BIN)/python -m dscp_ros.demo --campaign --output out/demo/campaign

demo-entry: $(READY) ## the same with a recorded entry; results in out/demo-entry
	$(BIN)/python -m dscp_ros.demo --problem entry --output out/demo-entry

benchmark: $(READY) ## print the measured figures
	$(BIN)/python -m benchmarks

clean: ## remove outputs, caches and build products; .venv stays
	rm -rf out build install log dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -exec rm -rf {} +
