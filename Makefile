# The first of these that runs and is 3.11 or 3.12. A name may exist and yet not run.
PYTHON ?= $(shell for python in python3.11 python3.12 python3; do \
	$$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' \
	>/dev/null 2>&1 && echo $$python && break; done)
EXPERIMENT ?= gppo_water
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip --disable-pip-version-check install $(if $(CI),--quiet) -c constraints.txt
RUN_STAMP := $(VENV)/.installed-run
DEV_STAMP := $(VENV)/.installed-dev
BENCH_STAMP := $(VENV)/.installed-bench

MAKEFLAGS += --no-print-directory
.DEFAULT_GOAL := help
.PHONY: train test test-full lint bench clean help

help:
	@echo 'make train [EXPERIMENT=$(EXPERIMENT)] [ARGS="seed=1 ..."]   train; prints the run directory last'
	@echo 'make test [ARGS="-k genome"]    run the quick tests'
	@echo 'make test-full                  what takes long: runs killed and worn out, more cases'
	@echo 'make lint                       check style, types and the dependency direction'
	@echo 'make bench [ARGS="ppo_epoch"]   measure speed: all benchmarks, or those that are named'
	@echo 'make clean                      remove .venv and what builds and tests leave; runs stay'

# Messages of the installation go to standard error: the last line that `make train`
# prints on standard output is the run directory.
$(BIN)/python:
	@test -n "$(PYTHON)" || { echo 'Python 3.11 or 3.12 is needed: make PYTHON=/path/to/python' >&2; exit 1; }
	@echo 'Making $(VENV) with $(PYTHON)' >&2
	@$(PYTHON) -m venv $(VENV) >&2 || { rm -rf $(VENV); exit 1; }

$(RUN_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing the package (once; torch is large)' >&2
	@$(PIP_INSTALL) -e . >&2
	@touch $@

$(DEV_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing the package and its tools (once; torch is large)' >&2
	@$(PIP_INSTALL) -e '.[test,dev]' >&2
	@touch $@ $(RUN_STAMP)

$(BENCH_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo 'Installing the package and what it is compared with (once; torch is large)' >&2
	@$(PIP_INSTALL) -e '.[bench]' >&2
	@touch $@ $(RUN_STAMP)

train: $(RUN_STAMP)
	@$(BIN)/gdrl-train experiment=$(EXPERIMENT) $(ARGS)

test: $(DEV_STAMP)
	@$(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

test-full: $(DEV_STAMP)
	@$(BIN)/python -m pytest -n 2 --dist worksteal -m full tests $(ARGS)

lint: $(DEV_STAMP)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright --pythonpath $(BIN)/python
	@$(BIN)/lint-imports

bench: $(BENCH_STAMP)
	@$(BIN)/python -m benchmarks $(ARGS)

clean:
	rm -rf $(VENV) build dist *.egg-info tasks/*.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -path ./runs -prune -o -name __pycache__ -type d -exec rm -rf {} +
