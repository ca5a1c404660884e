# `make demo` opens the studio on a demo plot; `make test` is the whole check. Both set up all they need first.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV ?= .venv
# Options for the program or for pytest, for example: make demo ARGS="--port 8081"
ARGS ?=

BIN := $(VENV)/bin
STAMPS := $(VENV)/.stamps
UV ?= uv

.PHONY: help
help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 20

# --- set-up: each step leaves a stamp, so that a second run does nothing and needs no network ---

.PHONY: setup setup-dev
setup: $(STAMPS)/run $(STAMPS)/system-run ## install the studio and the system libraries it needs
setup-dev: $(STAMPS)/dev $(STAMPS)/system-test ## the same, with what the tests need

INSTALL := $(PYTHON) tools/setup_venv.py --venv $(VENV) --editable --lock

$(STAMPS)/run: requirements/run.lock pyproject.toml tools/setup_venv.py
	@$(INSTALL) $<
	@mkdir -p $(STAMPS) && touch $@

# The dev lock holds all of the run lock, so the other step is done too.
$(STAMPS)/dev: requirements/dev.lock pyproject.toml tools/setup_venv.py
	@$(INSTALL) $<
	@mkdir -p $(STAMPS) && touch $(STAMPS)/run $@

# Without the right to install, the stamp stays away and the line to run is printed each time.
$(STAMPS)/system-run: $(STAMPS)/run
	@tools/system_packages.sh $(BIN)/python run $@

$(STAMPS)/system-test: $(STAMPS)/dev
	@tools/system_packages.sh $(BIN)/python test $@

# --- use ---

.PHONY: demo run doctor
demo: setup ## make the demo plot and open it in the studio (ARGS="--port 8081", ARGS=--no-serve)
	@$(BIN)/dbh-studio demo $(ARGS)

run: setup ## open a cloud or a saved plot in the studio: make run PLOT=path
	@test -n "$(PLOT)" || { echo "Say which plot:  make run PLOT=path/to/cloud.laz" >&2; exit 2; }
	@$(BIN)/dbh-studio open "$(PLOT)" $(ARGS)

doctor: setup ## say what is missing, what it costs and how to mend it
	@$(BIN)/python -m dbh_studio.app.doctor $(ARGS)

# --- development ---

.PHONY: test test-fast check fmt bench
test: check ## all checks and all tests, with the browser
	$(BIN)/python -m pytest $(ARGS)

test-fast: setup-dev ## the tests without the browser
	$(BIN)/python -m pytest -m "not browser" $(ARGS)

check: setup-dev ## style, types and layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

fmt: setup-dev ## put the code in the house style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup-dev ## measure speed and compare it with the committed baseline
	$(BIN)/python -m bench $(ARGS)

# Not part of `make test`: torch is never a dependency, and its wheel is larger than all the rest together.
PARITY_VENV ?= .venv-parity

.PHONY: parity
parity: $(PARITY_VENV)/.ready ## compare the trained models' runtime with transformers (fetches torch, 3 GB)
	PYTHONPATH=src:. $(PARITY_VENV)/bin/python -m pytest --noconftest tests/parity/test_transformers_parity.py $(ARGS)

$(PARITY_VENV)/.ready: requirements/parity.txt
	$(PYTHON) -m venv $(PARITY_VENV)
	$(PARITY_VENV)/bin/python -m pip install --quiet --requirement $<
	@touch $@

# The run lock is a part of the dev lock: the same versions are tested and shipped.
LOCK := pip compile pyproject.toml --universal --python-version 3.10 --generate-hashes --no-emit-index-url \
	--only-binary :all: --custom-compile-command "make lock" --quiet

.PHONY: lock clean
lock: ## resolve the locked requirements again (needs uv and network; ARGS=--upgrade)
	$(UV) $(LOCK) --group dev --output-file requirements/dev.lock $(ARGS)
	$(UV) $(LOCK) --group build --constraints requirements/dev.lock --output-file requirements/run.lock

clean: ## remove the environment, the caches and the build products
	rm -rf $(VENV) $(PARITY_VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +
