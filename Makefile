# Every target sets up what it needs. PYTHON picks the interpreter that makes the virtual environment.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.PHONY: help setup train test lint type docs clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

setup: $(VENV)/.installed  ## virtual environment with everything in it

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet -c constraints.txt -e ".[all]"
	touch $@

train: setup  ## the full method on noisy sparse cartpole (two distractors per state dimension)
	$(BIN)/python -m sb3_robust_bisim train --env robust_bisim/SparseCartPole-v0 --n-timesteps 7000 --seed 0 \
		--eval-freq 500 --eval-episodes 10 --log-interval 20 --progress --verbose 0 --log-folder logs --tensorboard-log logs/tensorboard

test: setup  ## all tests
	$(BIN)/python -m pytest -n 2

lint: setup  ## ruff: style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: setup  ## mypy
	$(BIN)/mypy sb3_robust_bisim benchmarks tests

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
