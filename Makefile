# `make help` lists the targets.
.DEFAULT_GOAL := help
.PHONY: help setup demo demo-eyes test test-together test-clock test-fast lint format docker docker-test bench lock dist clean

UV_VERSION := 0.13.8
PYTHON     ?= $(or $(shell command -v python3.12),$(shell command -v python3.13),python3.12)
export UV_PYTHON_DOWNLOADS := never
export UV_LINK_MODE ?= copy
export UV_SYSTEM_CERTS ?= true
# Hundreds of processes import torch and LeRobot: they share the bytecode that the first one writes.
unexport PYTHONDONTWRITEBYTECODE

# The machine's uv, or if it has none, one installed into .tools.
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo .tools/bin/uv)
BIN := .venv/bin

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-11s %s\n", $$1, $$2}'

setup: .venv/.installed  ## install the packages into .venv; as root also OpenGL and FFmpeg's libraries
	@.ci/system gl ffmpeg

.tools/bin/uv:
	$(PYTHON) -m venv .tools
	.tools/bin/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)

.venv/.installed: requirements.lock pyproject.toml plugin/pyproject.toml | $(filter .tools%,$(UV))
	$(UV) venv --quiet --allow-existing --python $(PYTHON) .venv
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock
	$(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e . -e ./plugin
	touch $@

.venv/.robots: robots.lock .venv/.installed
	$(UV) pip install --quiet --python $(BIN)/python --no-deps --require-hashes -r robots.lock
	touch $@

demo: setup  ## demonstrations, cloning, DAgger, evaluation, small: runs/demo/report.html
	$(BIN)/manip-il demo --output_dir=runs/demo $(DEMO)

demo-eyes: setup  ## train a policy on pictures from scratch, in half an hour: runs/eyes/test/report.html
	$(BIN)/manip-il dagger --config_path=configs/panda_dagger.yaml --output_dir=runs/eyes_state
	$(BIN)/manip-il data redraw runs/eyes_state runs/eyes_scenes --frames=30000
	$(BIN)/manip-il train --dataset.root=runs/eyes_scenes --policy.type=cnn --output_dir=runs/eyes
	$(BIN)/manip-il eval --policy.path=runs/eyes --eval.n_episodes=200 --eval.films=6 --output_dir=runs/eyes/test

# Two workers with one thread each: more threads than cores makes small networks slower, not faster.
# A file's tests run in one worker, so that their fixtures are made once; tests/conftest.py puts long files first.
# If a worker dies, the run ends: otherwise it would hang.
TWO := -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart=0 --ignore=tests/serve
# Real-time tests run last, with nothing heavy beside them: LeRobot waits only 50 ms for an answer.
test: test-together test-clock  ## run every test

test-together: setup .venv/.robots
	@.ci/system browser sshd
	OMP_NUM_THREADS=1 $(BIN)/pytest $(TWO)

test-clock: setup .venv/.robots
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/serve

test-fast: setup .venv/.robots  ## run the tests that take seconds and need no OpenGL
	OMP_NUM_THREADS=1 $(BIN)/pytest $(TWO) -m "not slow and not gl"
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/serve -m "not slow and not gl"

lint: setup  ## check style, types, import layers, and shapes in docstrings
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m tests.house

format: setup  ## format the code
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docker:  ## build the image manip-il; TORCH_BACKEND=cpu for a small one without CUDA
	docker build --build-arg TORCH_BACKEND=$(TORCH_BACKEND) --tag manip-il .

docker-test: setup  ## build an image, evaluate in it, compare with this environment
	.ci/docker

# One at a time: parallel runs would slow each other down. Without scripts that measure learning, which take hours.
SPEEDS := $(wildcard benchmarks/*_speed.py) $(addprefix benchmarks/,image_loading.py training_throughput.py \
	dagger_round.py ray_nodes.py scale.py gpu.py)
bench: setup  ## measure every speed ratio, in about 40 minutes; PEER=PYTHON with the imitation library
	@.ci/system sshd
	@set -e; for file in $(SPEEDS); do echo "== $$file"; $(BIN)/python "$$file"; done
	@echo "== benchmarks/time_to_policy.py"; $(BIN)/python benchmarks/time_to_policy.py $(addprefix --peer=,$(PEER))

lock: | $(filter .tools%,$(UV))  ## update requirements.lock after a change of pyproject.toml
	$(UV) pip compile --quiet --universal --generate-hashes --no-annotate --no-header --python $(PYTHON) --extra dev \
	    --no-emit-package metaworld pyproject.toml -o requirements.lock # it is in robots.lock

dist: setup  ## build wheels and sdists into dist/; PUBLISHER=https://HOST/OWNER/NAME for the links that an index shows
	$(UV) build --quiet --no-build-isolation --python $(BIN)/python --out-dir dist .
	$(UV) build --quiet --no-build-isolation --python $(BIN)/python --out-dir dist plugin

clean:  ## remove files that tools left; keeps .venv, runs and datasets
	rm -rf build dist *.egg-info plugin/build plugin/*.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find manip_il tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
