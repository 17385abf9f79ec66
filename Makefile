# make demo: run the main job. make test: lint, type-check and test; make test-all: the slow tests, too. make docs: the pages.
# Each installs all that it needs into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check
# Compiled programs are kept between runs: the second one starts at once.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/build/jax-cache
export MUJOCO_GL ?= disable

.PHONY: demo test test-all lint docs clean

demo: $(VENV)/run.stamp
	$(BIN)/lunar-mjx demo -o runs/demo

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

test-all: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright --level error

docs: $(VENV)/run.stamp
	$(PIP) install --quiet --progress-bar on -r requirements-docs.txt
	$(BIN)/mkdocs build --strict --site-dir build/docs

clean:
	rm -rf $(VENV) build runs

$(VENV)/run.stamp: requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"lunar-mjx needs Python 3.11 or newer, not {v[0]}.{v[1]}; set PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --progress-bar on -r requirements.txt
	$(PIP) install --quiet --no-deps -e .
	@touch $@

$(VENV)/dev.stamp: requirements-dev.txt $(VENV)/run.stamp
	$(PIP) install --progress-bar on -r requirements-dev.txt
	@touch $@
