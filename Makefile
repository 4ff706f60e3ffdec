# Everything runs in .venv, which `make setup` fills with the pins of constraints.txt.
PYTHON ?= python3
WORKERS ?= 2
DEVICE ?= cpu
SIZE := $(if $(QUICK),size=quick)
BROWSER := $(or $(CHROMIUM),$(firstword $(shell \
    command -v chromium chromium-browser google-chrome google-chrome-stable)))
INFLUENCE ?= $(if $(QUICK),outputs/influence_quick,docs/results)

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-done
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help setup test lint demo fetch-push reproduce figures watch online influence thresholds bench docs clean

# A stamp without its interpreter (moved folder, removed Python) does not count.
ifneq ($(shell $(BIN)/python -c 'print("ok")' 2>/dev/null),ok)
.PHONY: $(STAMP)
endif

help: ## show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) \
	    | awk -F ':.*## ' '{ printf "  make %-10s %s\n", $$1, $$2 }'

setup: $(STAMP) ## create .venv and install everything at its pin (about 6 GB)

$(STAMP): pyproject.toml constraints.txt
	@rm -f $(STAMP)
	@command -v $(PYTHON) >/dev/null || { \
	    echo "error: '$(PYTHON)' was not found. Install Python 3.10 or later, or" \
	         "name one: make PYTHON=/path/to/python3 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	    echo "error: Python 3.10 or later is needed, '$(PYTHON)' is" \
	         "$$($(PYTHON) --version 2>&1). Name another one:" \
	         "make PYTHON=/path/to/python3 ..." >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
	    $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	        echo "error: '$(PYTHON)' cannot create virtual environments: its venv" \
	             "or ensurepip module is missing. On Debian and Ubuntu:" \
	             "apt-get install python3-venv" >&2; exit 1; }; \
	    echo "creating $(VENV)"; $(PYTHON) -m venv --clear $(VENV); }
	@echo "installing the pinned packages (minutes on the first run)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[all]'
	@touch $(STAMP)

test: setup ## run all tests and the docstrings' examples
	$(if $(BROWSER),,@echo "no Chromium was found: 'make test' leaves out the tests" \
	    "that look at reports in a browser (apt-get install chromium)" >&2)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) \
	    $(if $(BROWSER),,-m 'not browser')

lint: setup ## check style, formatting, spelling and types
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/codespell
	$(BIN)/python -m mypy

demo: setup ## the motivating experiment in the kitchen (QUICK=1: a smoke run)
	@$(BIN)/python examples/study.py study=demo $(SIZE)

fetch-push: setup ## cloning of few demonstrations in Fetch-Push (QUICK=1: a smoke run)
	@$(BIN)/python examples/study.py study=fetch_push $(SIZE)

reproduce: setup ## run what is missing of a study (STUDY=kitchen_ratio, QUICK=1)
	@$(BIN)/python examples/study.py study=$(or $(STUDY),$(error name a study: \
	    make reproduce STUDY=one of $(basename $(notdir \
	    $(wildcard examples/conf/study/*.yaml))))) $(SIZE)

figures: setup ## draw the results of all studies again
	$(BIN)/python examples/figures.py

watch: setup ## film two agents of a study side by side (STUDY=demo EPISODE=0)
	@$(BIN)/python examples/watch.py study=$(or $(STUDY),demo) \
	    episode=$(or $(EPISODE),0) $(SIZE)

online: setup ## train offline, then collect and train in turn (QUICK=1)
	@$(BIN)/python examples/online.py $(if $(QUICK),size=quick online.rounds=1 \
	    online.episodes=2 online.steps=4)

influence: setup ## compare influence estimators (QUICK=1: a smoke run)
	@for env in fetch_push kitchen kitchen_all_tasks; do \
	    $(BIN)/python examples/compare_influence.py env=$$env \
	        publish=$(INFLUENCE) $(SIZE); done
	@for env in fetch_push_sliding ogbench_cube_double ogbench_scene; do \
	    $(BIN)/python examples/compare_influence.py env=$$env \
	        'method=[caiac,distance_action,motion,residual,oracle]' \
	        publish=$(INFLUENCE) $(SIZE); done

thresholds: setup ## compare suggested thresholds with the best ones
	@for env in fetch_push kitchen kitchen_all_tasks; do \
	    $(BIN)/python examples/suggest_thresholds.py env=$$env \
	        publish=$(INFLUENCE) $(SIZE); done
	$(BIN)/python examples/suggest_thresholds_ogbench.py --out outputs/ogbench \
	    --publish $(INFLUENCE)

bench: setup ## measure the hot paths, to docs/results (DEVICE=cpu or cuda)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest benchmarks --benchmark-only \
	    --device=$(DEVICE) --benchmark-json=benchmark-$(DEVICE).json \
	    --ratios=docs/results

docs: setup ## build the documentation, warnings are errors
	rm -rf docs/reference/generated
	MPLBACKEND=agg OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going \
	    -b html docs docs/_build/html
	$(if $(BROWSER),$(BIN)/python docs/check_site.py docs/_build/html,@echo \
	    "no Chromium was found: nobody has looked at the pages" >&2)

clean: ## remove what was built and cached; .venv and outputs stay
	rm -rf build dist *.egg-info docs/_build docs/auto_tutorials \
	    docs/reference/generated docs/errors.md \
	    .benchmarks .hypothesis .mypy_cache .pytest_cache .ruff_cache benchmark-*
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
