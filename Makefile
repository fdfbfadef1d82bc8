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

run: setup  ## the repo's answer into MLflow, two short trainings, the best shipped player's film, the verdict
	@echo '1 of 4: the kept runs of the answer into outputs/ and its MLflow store'
	@cp -R -n results/verdict/. outputs/ || test -d outputs/decisions/decide-7cfff86226  # some fail at what is there
	$(BIN)/python -m atlantis_exp sync
	@echo '2 of 4: two short trainings, about two minutes'
	$(BIN)/python -m atlantis_exp -m experiment=quick model=cnn,resnet phase.quick.steps=1_500
	@echo '3 of 4: a game of the best shipped player, about a minute'
	$(BIN)/python -m atlantis_exp evaluate weights=pretrained/cnn_annealed evaluation=quick episodes=1
	@echo '4 of 4: the verdict over the kept seeds'
	$(BIN)/python -m atlantis_exp compare by=model runs=decide-7cfff86226 seeds=10 at_epsilon=0.05
	@$(BIN)/python -c "from atlantis_exp import load_runs; \
	short = load_runs(runs='cnn-uniform-s0,resnet-uniform-s0', where='phase.quick.steps=1500', points=2); \
	means = ' and '.join(f'{mean:,.0f}' for mean in short.runs['evaluation/mean']); \
	print(f'\nyour two short trainings: {means} points: too short to say anything')"
	@echo; echo 'the film:' outputs/evaluations/cnn_annealed-*/artifacts/best_episode.mp4; echo 'all of it in a browser: make ui'

test: lint  ## lint, types and the quick tests
	$(ONE_THREAD) $(BIN)/python -m pytest -q -n 2 --dist worksteal

test-all: lint  ## every test, the slow ones too
	$(ONE_THREAD) $(BIN)/python -m pytest -q -n 2 --dist worksteal -m ''

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
