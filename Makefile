# Every target makes what it needs on a machine that has Python >= 3.11 (with venv) and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO_ARGS ?=
# Test modules at a time; integration tests mostly wait.
TEST_JOBS ?= 2
REAL_JOBS ?= 4
# Which tests: what is marked `long` tells a whole story, or again what a shorter test tells too.
MARK ?= not long
# Of the long ones only a share, OWN/COUNT, OWN from 0; `.ci/run` says which.
LONG ?=
ONLY = -m "$(MARK)" $(if $(LONG),--long-share=$(LONG))
# How the tests with real processes are run; `.ci/run` gives failed ones a second chance, alone.
PYTEST_REAL ?= -m pytest

.PHONY: help demo test test-all test-cpu test-real test-quick test-ros lint types format man bench deb wheel image lock clean
.NOTPARALLEL:
# Where it is set, each daemon, relay and worker of a test compiles all its modules anew: half of its start.
unexport PYTHONDONTWRITEBYTECODE

help:  ## Show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 14

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "zsched needs Python 3.11 or newer; say which one with: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.lab: pyproject.toml lab/pyproject.toml $(VENV)/.python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e . -e ./lab
	@touch $@

$(VENV)/.dev: pyproject.toml lab/pyproject.toml $(VENV)/.python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -e ./lab
	@touch $@ $(VENV)/.lab

demo: $(VENV)/.lab  ## Watch six machines merge laser maps (DEMO_ARGS="--headless --out DIR" to choose)
	$(BIN)/zsched demo $(DEMO_ARGS)

test: test-cpu test-real  ## All tests but the long ones

test-all: MARK =
test-all: test  ## All tests

test-cpu: $(VENV)/.dev  ## Tests that only need a processor: unit, paper, simulator
	$(BIN)/python -m pytest -q $(ONLY) -n $(TEST_JOBS) --dist loadfile tests/unit tests/paper tests/sim tests/planted

# Real fleets of the system tests, and live cells of the bench, keep real time and fill a machine: they have it to
# themselves.
test-real: $(VENV)/.dev  ## Tests with real processes (real daemons on localhost, booted machines, bench)
	$(BIN)/python $(PYTEST_REAL) -q $(ONLY) --durations=10 tests/system tests/bench
	$(BIN)/python $(PYTEST_REAL) -q $(ONLY) -n $(REAL_JOBS) --dist loadfile --no-loadscope-reorder --durations=10 \
	  tests/booted tests/integration tests/parts

# Where the wheels do not install (another Python or processor, no network) the tests are skipped, and say why.
.venv-ros/.ros: tests/ros/requirements.txt $(VENV)/.python
	@rm -rf .venv-ros
	@{ $(BIN)/python -m venv .venv-ros && .venv-ros/bin/python -m pip install --quiet --disable-pip-version-check \
	  --only-binary :all: --no-binary empy,lark-parser -r tests/ros/requirements.txt; } >.venv-ros.log 2>&1 && touch $@ || tail -n 1 .venv-ros.log

test-ros: $(VENV)/.dev .venv-ros/.ros  ## Tests with real ROS 2 nodes, where its wheels install
	$(BIN)/python $(PYTEST_REAL) -q $(ONLY) --durations=10 tests/ros

test-quick: $(VENV)/.dev  ## Unit and paper tests only
	$(BIN)/python -m pytest -q -n $(TEST_JOBS) --dist loadfile tests/unit tests/paper

lint: $(VENV)/.dev  ## ruff, format check, mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

types: $(VENV)/.dev  ## mypy --strict
	$(BIN)/mypy

format: $(VENV)/.dev  ## Format everything
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

man: $(VENV)/.dev  ## Write the manual pages anew (man/), from the texts of --help
	rm -f man/*.1
	$(BIN)/python package/manual.py man

bench: $(VENV)/.dev  ## Print figures (takes some minutes; keep the machine quiet)
	$(BIN)/python -m benchmarks.run

# The wheels' platforms and hashes are in package/requirements.lock; nothing else is fetched. No root is needed.
deb: $(VENV)/.dev  ## Build dist/zsched_*.deb (ARCH=aarch64; PYTHON_DIST=FILE: with a Python of its own)
	$(BIN)/python package/deb/build.py $(if $(ARCH),--arch $(ARCH)) $(if $(PYTHON_DIST),--python-dist $(PYTHON_DIST))

wheel: $(VENV)/.dev  ## Build dist/zsched-*.whl, with its SBOM
	rm -f dist/zsched-*.whl
	$(BIN)/python package/wheel.py dist

# The image takes the wheel in dist/: there may be one only.
ENGINE ?= $(if $(shell command -v podman),podman,docker)
image: wheel  ## Build the container image (podman, else docker; ENGINE, BASE=IMAGE, IMAGE_ARGS="..." to choose)
	$(ENGINE) build $(if $(BASE),--build-arg BASE=$(BASE)) $(IMAGE_ARGS) -f package/Containerfile -t zsched .

lock: $(VENV)/.dev  ## Write package/requirements.lock anew: the newest releases that pyproject.toml allows
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade \
	  --custom-compile-command "make lock" pyproject.toml -o package/requirements.lock

clean:  ## Remove the virtual environment and caches
	rm -rf $(VENV) .venv-ros .venv-ros.log .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist *.egg-info
