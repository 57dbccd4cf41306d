# Every target sets up what it needs. PYTHON picks the interpreter that makes the virtual environment.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

# Drawing without a GPU or a display; installed where that may be done
OPENGL         := libegl1 libgl1 libgl1-mesa-dri libosmesa6
HAS_OPENGL     := import sys; from ctypes.util import find_library as f; sys.exit(not (f('EGL') or f('OSMesa')))
INSTALL_OPENGL := test "$$(id -u)" = 0 && apt-get -qq update && apt-get -qq install -y $(OPENGL) >/dev/null

.PHONY: help setup train train-pixels test test-sb3 test-oldest lint type docs licences audit dist clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "%-14s%s\n", $$1, $$2}'

setup: $(VENV)/.installed  ## virtual environment with everything in it

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet -c constraints.txt -e ".[all]"
	@$(BIN)/python -c "$(HAS_OPENGL)" || { $(INSTALL_OPENGL); } || echo "Pixel tasks need OpenGL: install $(OPENGL) yourself." >&2
	touch $@

train: setup  ## the full method on noisy sparse cartpole (two distractors per state dimension)
	$(BIN)/python -m sb3_robust_bisim train --env robust_bisim/SparseCartPole-v0 --n-timesteps 10000 --seed 0 \
		--eval-freq 500 --eval-episodes 10 --log-interval 20 --progress --verbose 0 --log-folder logs --tensorboard-log logs/tensorboard

train-pixels: setup  ## six minutes or more of cartpole-swingup from pixels with video behind it; ends with a video of the agent
	$(BIN)/python -m sb3_robust_bisim train --env robust_bisim/cartpole-swingup-pixels-v0 --variant self-prediction small \
		--n-timesteps 12000 --seed 0 --eval-freq 4000 --eval-episodes 2 --progress --verbose 0 --log-folder logs \
		--tensorboard-log logs/tensorboard

test: setup  ## all tests
	$(BIN)/python -m pytest -n 2 --dist loadgroup

SB3_TESTS := run save_load cnn train_eval_mode her dict_env vec_normalize callbacks predict sde spaces deterministic \
	custom_policy tensorboard gae
# a selection: the files about SAC; what is left out of them has its reason in CONTRIBUTING.md
SB3_LEFT_OUT := test_cnn.py::test_image_like_input[True-BisimSAC] test_cnn.py::test_image_like_input[False-BisimSAC] \
	test_dict_env.py::test_vec_normalize[BisimSAC] test_vec_normalize.py::test_her_normalization \
	test_vec_normalize.py::test_offpolicy_normalization[BisimSAC] test_tensorboard.py::test_tensorboard[sac] \
	test_gae.py::test_infinite_horizon[True-BisimSAC] test_save_load.py::test_warn_buffer[True-BisimSAC] \
	test_save_load.py::test_warn_buffer[False-BisimSAC] \
	test_spaces.py::test_action_spaces[CartPole-v1-BisimSAC]

test-sb3: setup  ## Stable-Baselines3's own tests of SAC, with BisimSAC in its place
	mkdir -p build && cd build && rm -rf stable_baselines3-* && \
		../$(BIN)/pip download --quiet --no-deps --no-binary stable_baselines3 -c ../constraints.txt stable_baselines3 && \
		tar xzf stable_baselines3-*.tar.gz && cd stable_baselines3-*/ && \
		OMP_NUM_THREADS=1 PYTHONPATH=../../tests/upstream ../../$(BIN)/python -m pytest -p swap_sac -q -n 2 -k "BisimSAC or sac or her or train_freq" \
		$(foreach test,$(SB3_LEFT_OUT),"--deselect=tests/$(test)") $(SB3_TESTS:%=tests/test_%.py)

OLDEST := build/oldest

# lowest-direct: the lower bounds of setup.cfg, and of their own requirements the newest. torch is the pinned one, because PyPI
# has its older versions only with CUDA. tests/test_supply_chain.py is about the pinned versions.
test-oldest:  ## all tests with the oldest versions that setup.cfg allows
	mkdir -p build && $(PYTHON) -m venv $(OLDEST) && grep '^torch==' constraints.txt >build/torch.txt
	$(OLDEST)/bin/pip install --quiet -c constraints.txt uv
	$(OLDEST)/bin/uv pip install --quiet --python $(OLDEST)/bin/python --resolution lowest-direct -c build/torch.txt \
		$${PIP_FIND_LINKS:+--find-links $$PIP_FIND_LINKS} ".[dmc,plots,theory,sweep,test]"
	$(OLDEST)/bin/python -m pytest -n 2 --dist loadgroup --deselect tests/test_supply_chain.py

lint: setup  ## ruff: style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: setup  ## mypy: the package is fully typed
	$(BIN)/mypy sb3_robust_bisim

docs: setup  ## HTML documentation in docs/_build
	$(BIN)/python -m sphinx -q -b html docs docs/_build

licences: setup  ## docs/licences.md: the licences of everything that a plain installation brings
	$(BIN)/python tests/licences.py >docs/licences.md

audit:  ## known vulnerabilities of the pinned versions; asks the network
	mkdir -p build && $(PYTHON) -m venv build/audit && build/audit/bin/pip install --quiet pip-audit
	build/audit/bin/pip-audit --disable-pip --no-deps -r constraints.txt

dist: setup  ## sdist and wheel in dist/, checked for upload
	$(BIN)/pip install --quiet -c constraints.txt -e ".[dist]"
	rm -rf dist *.egg-info
	$(BIN)/python -m build --no-isolation
	$(BIN)/twine check --strict dist/*

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info build dist docs/_build
