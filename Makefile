# make setup   the environment in .venv         make demo   the whole story, small
# make test    lint is separate: make lint      make bench  every speed ratio
.PHONY: setup demo test test-fast lint format bench lock clean

UV_VERSION := 0.13.8
PYTHON     ?= python3.12
export UV_PYTHON_DOWNLOADS := never
export UV_LINK_MODE ?= copy

# uv is taken from the machine, else brought into .tools (a folder of the project's own).
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo .tools/bin/uv)
BIN := .venv/bin

setup: .venv/.installed

.tools/bin/uv:
	$(PYTHON) -m venv .tools
	.tools/bin/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)

.venv/.installed: requirements.lock pyproject.toml | $(filter .tools%,$(UV))
	$(UV) venv --quiet --allow-existing --python $(PYTHON) .venv
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock
	$(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e .
	touch $@

lock: | $(filter .tools%,$(UV))
	$(UV) pip compile --quiet --universal --generate-hashes --no-annotate --no-header \
	    --python $(PYTHON) --extra dev pyproject.toml -o requirements.lock
