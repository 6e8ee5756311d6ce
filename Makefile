# `make demo` and `make test` are all that a fresh machine needs: each makes the environment first, when it is
# missing or older than setup.cfg. Needed beforehand: Python 3.11 or newer, git, make; with a C++ compiler the kernels
# for the CPU are built too.

SHELL := /bin/bash
VENV  ?= .venv
BIN   := $(VENV)/bin
JOBS  ?= 2

# The first interpreter that is new enough.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)

# The modules whose lines must be covered: what the operators consist of.
CORE := lsmgeo/_*.py,lsmgeo/errors.py,lsmgeo/debugging.py,lsmgeo/grids.py,lsmgeo/functional/*,lsmgeo/layers.py,lsmgeo/fusion.py,lsmgeo/rays.py,lsmgeo/cameras/*,lsmgeo/kernels/*
CORE_COVERAGE := 95
# Triton compiles these: their lines do not run as Python, and tests/kernels/test_triton*.py hold them by their answers.
DEVICE_CODE := lsmgeo/kernels/triton/forward.py,lsmgeo/kernels/triton/backward.py

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-floors test-long lint docs bench wheel clean

help: ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# A plain path to the checkout: the default form of an editable install loses to a folder of the package's name beside the
# script that imports it.
EDITABLE := --config-settings editable_mode=compat -e

# uv installs in a tenth of pip's time. It is used where it is on PATH or can be fetched, and pip does the work otherwise.
# $(1): bin folder of the environment, $(2): what to install, $(3): options of uv
define install
	@if UV=$$(command -v uv) || { $(1)/python -m pip install --quiet uv 2>/dev/null && UV=$(1)/uv; }; then \
		"$$UV" pip install --quiet $(3) --python $(1)/python $(2) && exit 0; \
		echo 'uv could not install; trying pip' >&2; \
	fi; \
	$(1)/python -m pip install --quiet $(2)
endef

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo 'Python 3.11 or newer is needed; name one with make PYTHON=/path/to/python' >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# What the installation is made from.
SOURCES := setup.cfg setup.py pyproject.toml $(wildcard lsmgeo/kernels/native/*.h lsmgeo/kernels/native/*.cpp)

$(VENV)/.core: $(SOURCES) | $(BIN)/python
	@echo 'installing lsmgeo into $(VENV) (once; PyTorch is large)'
	$(call install,$(BIN),$(EDITABLE) .,--compile-bytecode)
	@touch $@

$(VENV)/.dev: $(SOURCES) | $(BIN)/python
	@echo 'installing lsmgeo and what its tests and docs need into $(VENV) (once; PyTorch is large)'
	$(call install,$(BIN),$(EDITABLE) '.[dev]',--compile-bytecode)
	@touch $(VENV)/.core $@

setup: $(VENV)/.dev ## make the environment, with everything for tests and docs

demo: $(VENV)/.core ## run the main job on an analytic scene; images go to demo/
	$(BIN)/lsmgeo demo --out demo

# One thread a process: two workers of two threads each run slower than two of one.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

# Tests on real posed images read the folder that LSMGEO_TEST_DATA names; without it they skip, and say so.
test: $(VENV)/.dev ## whole suite, doctests, and the core's coverage
	@rm -f .coverage .coverage.*
	$(PYTEST) -n $(JOBS) --dist worksteal -m 'not long' --cov --cov-report= --durations=10
	@echo 'lines of the core:'
	@$(BIN)/coverage report --include='$(CORE)' --omit='$(DEVICE_CODE)' --fail-under=$(CORE_COVERAGE)

# An environment of the lowest versions that setup.cfg admits, with only PyTorch, kornia and NumPy.
# They have no wheels for Python 3.13.
FLOORS := $(VENV)-floors
FLOORS_PYTHON ?= $(shell for p in $(BIN)/python python3.11 python3.12 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info[:2] > (3, 12))' 2>/dev/null && { echo $$p; break; }; done)
$(FLOORS)/.made: setup.cfg | $(BIN)/python
	@test -n "$(FLOORS_PYTHON)" || { echo 'the lowest versions need Python 3.11 or 3.12; name one: FLOORS_PYTHON=' >&2; exit 1; }
	@echo 'installing the oldest PyTorch, kornia and NumPy into $(FLOORS) (once; PyTorch is large)'
	$(FLOORS_PYTHON) -m venv --clear $(FLOORS)
	$(call install,$(FLOORS)/bin,$$(sed -nE 's/^ +((torch|kornia|numpy))>=/\1==/p; s/^ +((pytest|hypothesis).*)/\1/p' setup.cfg))
	@touch $@

# The operators as in somebody's own environment: lsmgeo without its other dependencies, without the C++ kernels (no
# compiler is found) and without Triton. The checkout is out of sight, so that what is installed is what is tested.
CORE_MODULES := $(addprefix lsmgeo.,cameras kernels grids functional layers fusion rays)
test-floors: $(FLOORS)/.made ## the operators' tests at the lowest versions, with only PyTorch, kornia and NumPy beside it
	@rm -rf build/lib* build/floors && mkdir -p build/floors && ln -s ../../tests ../../setup.cfg build/floors
	CC=false CXX=false $(FLOORS)/bin/python -m pip install --quiet --no-deps --force-reinstall .
	cd build/floors && LSMGEO_NATIVE=0 LSMGEO_TEST_WITHOUT_TRITON=1 HYPOTHESIS_PROFILE=dev OMP_NUM_THREADS=1 \
		$(abspath $(FLOORS))/bin/python -m pytest -n $(JOBS) --dist worksteal -m 'not long' --pyargs \
		$(CORE_MODULES) tests/kernels tests/property tests/interop/test_compile.py::test_gradients_of_a_graph

test-long: $(VENV)/.dev ## the long forms: random examples in number, slow checks
	HYPOTHESIS_PROFILE=long $(PYTEST) -n $(JOBS) --dist worksteal --timeout 3600 --durations=20

lint: $(VENV)/.dev ## ruff, mypy, static gates
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python tests/static_gates.py

docs: $(VENV)/.dev ## pages and executed gallery, to docs/_build/html
	OMP_NUM_THREADS=$(JOBS) $(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html
	@echo 'docs: docs/_build/html/index.html'

bench: $(VENV)/.dev ## the operators against hand-written, compiled and other systems' forms; time and memory
	$(BIN)/python -m benchmarks

wheel: $(VENV)/.core ## build the wheel, install it into a clean environment, run the demo from there
	@rm -rf dist build
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	@rm -rf build/clean && $(BIN)/python -m venv build/clean
	$(call install,build/clean/bin,dist/*.whl)
	cd build && clean/bin/lsmgeo demo --out wheel-demo
	@ls -l dist

clean: ## remove what the commands wrote and built; what was installed from elsewhere stays
	rm -rf build dist *.egg-info lsmgeo/kernels/native/_native.* $(VENV)/.core $(VENV)/.dev demo docs/_build docs/auto_examples docs/api/generated docs/sg_execution_times.rst
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage .coverage.* htmlcov
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
