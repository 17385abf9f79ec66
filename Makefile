# make demo: run the main job. make test: lint, type-check and test; make test-all: the slow tests, too. make docs: the pages.
# make busy-test: the fast tests where other processes take the processors, three times.
# make proofs: slow tests in turn, 50 minutes of them, those with a record first; make all-proofs: all of them,
# with the table of when each last passed.
# Each installs all that it needs into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check
# Compiled programs are kept between runs: the second one starts at once.
export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/build/jax-cache
export MUJOCO_GL ?= disable

# Modules are byte-compiled as they are imported: most of what is installed never is.
export PIP_NO_COMPILE ?= 1

# Tests compile far more than they run; these take half the time of the usual ones. (Tests marked `optimised` do not, and
# test-all does not.) Thousands of programs compile in less than the second below which JAX keeps none: kept, they are shared
# by both processes and by the next run.
FAST_COMPILE := JAX_DISABLE_MOST_OPTIMIZATIONS=1 JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: demo test fast-tests busy-test test-all for-proofs proofs all-proofs lint docs foreign-tune foreign-report hashes clean

demo: $(VENV)/run.stamp
	$(BIN)/lunar-mjx demo -o runs/demo

test: $(VENV)/dev.stamp
	@$(MAKE) --no-print-directory --jobs=2 lint fast-tests

fast-tests: $(VENV)/dev.stamp
	$(FAST_COMPILE) $(PYTEST) -m "not slow"

# Three times beside eight busy processes on each pair of processors, each time in another random order.
busy-test: $(VENV)/dev.stamp
	$(BIN)/python -m tests.busy

test-all: lint
	$(PYTEST)

# The build of torch without CUDA (190 MB for 3 GB), where an index has it; SB3's proof is skipped elsewhere.
SB3 := stable-baselines3==2.9.2 torch==2.13.0+cpu
PARTICLES := newton==1.8.0 warp-lang==1.19.0
for-proofs: $(VENV)/dev.stamp
	@timeout 180 $(PIP) install --quiet -c requirements-dev.txt $(SB3) || echo "no CPU build of torch at hand: SB3's proof is skipped"
	@timeout 180 $(PIP) install --quiet -c requirements-dev.txt $(PARTICLES) || echo "no Newton at hand: the proof on particles is skipped"
	@timeout 180 $(PIP) install --quiet -c requirements-dev.txt -r requirements-docs.txt || echo "no MkDocs at hand: the proof on the site is skipped"

PROOF_MINUTES ?= 50
proofs: for-proofs
	$(BIN)/python -m tests.proofs --minutes $(PROOF_MINUTES)

all-proofs: for-proofs
	$(BIN)/python -m tests.proofs --all --record

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright --level error

docs: $(VENV)/run.stamp
	$(PIP) install --quiet --progress-bar on -r requirements-docs.txt
	$(BIN)/mkdocs build --strict --site-dir build/docs

# Foreign worlds: what criticism says of wheels that share no law with the tool. Both go on where they were stopped. The
# report's tables are drawn from the commit: each commit has a folder and tables of its own.
FOREIGN_TABLES ?= 60
FOREIGN_DRIVES ?= 12
FOREIGN_REPORT_TABLES ?= 600
FOREIGN_REPORT_DRIVES ?= 60
foreign-tune: FOREIGN := build/foreign/tune
foreign-tune: $(VENV)/run.stamp
	$(BIN)/python -m benchmarks.foreign make --set tune --tables $(FOREIGN_TABLES) --drives $(FOREIGN_DRIVES) -o $(FOREIGN)
	$(BIN)/python -m benchmarks.foreign run $(FOREIGN)
	$(BIN)/python -m benchmarks.foreign score $(FOREIGN)

foreign-report: FOREIGN = build/foreign/report-$(shell git rev-parse --short HEAD)
foreign-report: $(VENV)/run.stamp
	$(BIN)/python -m benchmarks.foreign make --set report --tables $(FOREIGN_REPORT_TABLES) --drives $(FOREIGN_REPORT_DRIVES) -o $(FOREIGN)
	$(BIN)/python -m benchmarks.foreign run $(FOREIGN)
	$(BIN)/python -m benchmarks.foreign score $(FOREIGN)

# Hashes of all files of every pinned version, for pip install --require-hashes; needed after a change of requirements*.txt.
hashes: $(VENV)/run.stamp
	$(PIP) install --quiet uv
	$(BIN)/uv pip compile --quiet --no-deps --generate-hashes --universal --python-version 3.11 --no-annotate \
		--custom-compile-command "make hashes" -o requirements-hashed.txt requirements-dev.txt requirements-docs.txt

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
