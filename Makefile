# make demo   a synthetic capture through all five stages
# make test   every test that is not slow
# make test-all   the whole test suite
# make test-package   wheel and sdist, built and installed apart; the smoke demo run from the wheel
# make lint   ruff, codespell and mypy
# make docs   the documentation as a site, in site/; a broken link is an error
# make dist   wheel and sdist, in dist/
# make test-gpu-kernels   the GPU kernels, without a GPU: in Triton's interpreter, and compiled ahead of time
# make convert-env   .venv-convert, in which `cleargs models install` converts PyTorch checkpoints
# make test-convert  the tests of those conversions
# make browser       what the tests of the report in a browser need beside Debian's chromium
# make oracles       .oracles, npm's programs that read exported scenes in the tests
# make cluster       .venv-cluster, the Snakemake that `cleargs batch` uses
# TORCH_INDEX=URL passes pip another index for torch (a CPU-only build, say).

PYTHON ?= python3
BIN := .venv/bin
PIP_INSTALL := python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	$(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
PIP := $(BIN)/$(PIP_INSTALL)

.PHONY: demo test test-all test-package test-gpu-kernels lint docs dist convert-env test-convert cluster browser oracles clean

demo: .venv/demo.stamp demo/capture/transforms.json
	$(BIN)/cleargs run demo/capture -o demo/run --workflow smoke --set ingest.poses=sfm

test: .venv/test.stamp
	$(BIN)/python -m pytest -m 'not slow'

test-all: .venv/test.stamp
	$(BIN)/python -m pytest

# In an environment of its own below dist/: what is tested there is the wheel, never the checkout.
test-package: dist
	rm -rf dist/env dist/try
	$(PYTHON) -m venv dist/env
	dist/env/bin/$(PIP_INSTALL) dist/*.tar.gz
	dist/env/bin/$(PIP_INSTALL) --no-deps --force-reinstall dist/*.whl
	mkdir dist/try
	cd dist/try && ../env/bin/python -P ../../tests/installed.py
	cd dist/try && ../env/bin/cleargs synth capture --protocol mixed --frames 8 --size 240x136
	cd dist/try && ../env/bin/cleargs run capture -o run --workflow smoke
	cd dist/try && ../env/bin/cleargs verify run

dist: .venv/dev.stamp
	rm -rf dist build
	$(BIN)/python -m build --quiet --outdir dist .
	rm -rf build

docs: .venv/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

test-gpu-kernels: .venv/cuda.stamp
	TRITON_INTERPRET=1 $(BIN)/python -m pytest tests/gpu

lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy cleargs stages

convert-env: .venv-convert/stamp

test-convert: convert-env
	.venv-convert/bin/python -m pytest tests/models

browser: .venv/browser.stamp

oracles: .oracles/stamp

.oracles/stamp: Makefile
	npm install --prefix .oracles --ignore-scripts --silent \
		@playcanvas/splat-transform@3.7.0 gltf-validator@2.0.0-dev.3.10
	touch $@

# An environment of its own: the engine wants numpy and pandas of its own choosing.
cluster: .venv-cluster/stamp

.venv-cluster/stamp: Makefile
	$(PYTHON) -m venv .venv-cluster
	.venv-cluster/bin/python -m pip install --quiet --disable-pip-version-check \
		'snakemake>=9.20,<10' 'snakemake-executor-plugin-slurm>=2.8,<3'
	touch $@

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

.venv/browser.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[test,browser]'
	touch $@

# The Triton that the tests passed with; a CPU build of PyTorch leaves the choice open.
.venv/cuda.stamp: Makefile pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[test,cuda]' 'triton==3.8.*'
	touch $@

.venv/dev.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[test,dev]'
	touch $@

.venv/docs.stamp: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e '.[docs]'
	touch $@

.venv-convert/stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-convert
	.venv-convert/bin/$(PIP_INSTALL) -e '.[convert]' pytest hypothesis
	.venv-convert/bin/$(PIP_INSTALL) --no-deps pyiqa==0.1.16 openai-clip==1.0.1
	touch $@

clean:
	rm -rf demo build dist site *.egg-info .venv .venv-convert .venv-cluster .oracles
