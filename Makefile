# make demo   a synthetic capture through all five stages
# make test   the whole test suite
# TORCH_INDEX=URL passes pip another index for torch (a CPU-only build, say).

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	$(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

.PHONY: demo test lint clean

demo: .venv/demo.stamp demo/capture/transforms.json
	$(BIN)/cleargs run demo/capture -o demo/run --workflow smoke --set ingest.poses=sfm

test: .venv/test.stamp
	$(BIN)/python -m pytest

lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy cleargs stages

demo/capture/transforms.json: | .venv/demo.stamp
	rm -rf demo/capture
	$(BIN)/cleargs synth demo/capture --protocol mixed --frames 16 --size 480x270

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/demo.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e .
	touch $@

.venv/test.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[test]'
	touch $@

.venv/dev.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[test,dev]'
	touch $@

clean:
	rm -rf demo build dist *.egg-info .venv
