PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Of torch: the tests' networks are too small to share, and threads that wait for each other slow the whole machine.
ONE_THREAD := OMP_NUM_THREADS=1

.DEFAULT_GOAL := help
.PHONY: help setup run test test-all test-slurm mutants lint docs ui clean

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("make: Python 3.11 or newer is needed, as in PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

setup: $(VENV)/.installed  ## create .venv and install everything

run: setup  ## random baseline, both networks trained, the shipped one plays; a film, a page, a verdict
	$(BIN)/python -m atlantis_exp baseline evaluation=quick
	$(BIN)/python -m atlantis_exp -m experiment=quick model=cnn,resnet phase.quick.steps=1_500
	$(BIN)/python -m atlantis_exp evaluate weights=pretrained/cnn_fast evaluation=quick episodes=1
	$(BIN)/python -m atlantis_exp compare

test: lint  ## lint, types and the quick tests
	$(ONE_THREAD) $(BIN)/python -m pytest -q -n 2 --dist loadfile

test-all: lint  ## every test, the slow ones too
	$(ONE_THREAD) $(BIN)/python -m pytest -q -n 2 --dist loadfile -m ''

test-slurm: setup  ## a sweep on a real Slurm, where Debian's slurmctld, slurmd and slurm-client are installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[slurm]'
	$(ONE_THREAD) $(BIN)/python -m pytest -q -rs -m '' tests/slurm

mutants: setup  ## which small faults the quick tests notice, with a score; takes a night
	$(ONE_THREAD) $(BIN)/python tests/mutants.py

lint: setup  ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@

docs: $(VENV)/.docs  ## the pages as a site that can be searched: open site/index.html
	$(BIN)/python docs/site.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

ui: setup  ## the MLflow UI on the local store
	$(BIN)/python -m atlantis_exp ui

clean:  ## remove .venv and caches (never outputs/)
	rm -rf $(VENV) .site site .pytest_cache .mypy_cache .ruff_cache .hypothesis
