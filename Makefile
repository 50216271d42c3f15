# make demo              install the program and run all stages on a small synthetic capture; the last line names its report
# make env               install the program alone, in .venv
# make test              run all tests that are not slow, apart from those of benchmarks/
# make test-quick        run those of files that take less than three seconds of a processor each
# make test-all          run all tests
# make coverage          run the tests of `make test`, and name the lines of the program that they do not run
# make test-package      build wheel and sdist, install them separately, and run the smoke demo from the wheel
# make drill             kill every stage and gc 50 times, plant 1,000 links in runs, and compare
# make fuzz              read 2,000 mutations of each kind of file; SEED=N selects others
# make findings          run the scripts of findings/, which need the network: what other libraries and formats really do
# make lint              ruff, codespell, mypy and the check of the prose (tools/prose.py)
# make docs              build the documentation site in site/; a broken link is an error
# make dist              build wheel and sdist in dist/
# make test-gpu-kernels  test the GPU kernels without a GPU: in Triton's interpreter, and compiled ahead of time
# make convert-env       install .venv-convert, in which tools/convert_models converts PyTorch checkpoints
# make test-convert      run the tests of these conversions
# make browser           install what the browser tests of the report need in addition to Debian's chromium
# make oracles           install .oracles, programs of others that read exported scenes and captures in the tests
# make cluster           install .venv-cluster, the Snakemake that runs a sheet on a cluster
# TORCH_INDEX=URL gives pip an extra index of packages, for PyTorch's CPU build, which is much smaller.
# INSTALL_OPTIONS=--no-compile lets Python compile the modules that it imports in place of all that are installed.

PYTHON ?= python3
BIN := .venv/bin
TORCH_INDEX ?=

# $(call install,ENVIRONMENT,SECTIONS OF requirements.lock,OUR PACKAGE,PACKAGES OF PYTORCH): pip checks the digest of every
# file, except those of torch, whose builds differ by machine.
INSTALL_OPTIONS ?=
PIP_INSTALL := python -m pip install --disable-pip-version-check $(INSTALL_OPTIONS)
define install
	@echo "$(1): pip downloads Python packages, 0.4 GB without PyTorch, and shows each. PyTorch is 0.2 GB for CPUs, and some GB for GPUs."
	awk -v wanted=" $(2) " '/^## /{take = index(wanted, " " $$2 " ")} take' requirements.lock > $(1)/requirements.txt
	$(1)/bin/$(PIP_INSTALL) --require-hashes --no-deps -r $(1)/requirements.txt
	$(if $(3),$(1)/bin/$(PIP_INSTALL) -c constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch $(4))
	$(if $(3),$(1)/bin/$(PIP_INSTALL) --no-deps --no-build-isolation $(3))
endef
PINS := pyproject.toml requirements.lock constraints.txt

.PHONY: demo env test test-quick test-all coverage test-package drill fuzz findings test-gpu-kernels lint docs dist convert-env test-convert cluster browser oracles clean

env: .venv/demo.stamp
	@echo "ClearGS is installed in $(CURDIR)/.venv. Next, in the folder of your video:"
	@echo "  source $(CURDIR)/.venv/bin/activate"
	@echo "  cleargs run walk.mp4 --quality draft"

demo: .venv/demo.stamp
	$(BIN)/cleargs demo

# The tests of a file run in one process, so that they make shared fixtures once.
PARALLEL := --numprocesses auto --maxprocesses 4 --dist loadfile

test: .venv/test.stamp
	$(BIN)/python tests/warm_kernels.py
	$(BIN)/python -m pytest -m 'not slow and not benchmarks' $(PARALLEL)

test-quick: .venv/test.stamp
	$(BIN)/python -m pytest -m 'not slow and not benchmarks and not heavy' $(PARALLEL)

test-all: .venv/test.stamp
	$(BIN)/python -m pytest

# Name the lines of the program that `make test` does not run: measured once per release, for docs/testing.md.
coverage: .venv/dev.stamp
	$(BIN)/python tests/warm_kernels.py
	$(BIN)/python -m coverage erase
	$(BIN)/python -m coverage run -m pytest -m 'not slow and not benchmarks' $(PARALLEL)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage report --skip-covered --sort=cover

# A separate environment in dist/, so that the tests use the wheel and not the checkout. Kernels whose sources are the
# same are not compiled again.
test-package: dist
	rm -rf dist/env dist/try
	$(PYTHON) -m venv dist/env
	$(call install,dist/env,base,dist/*.tar.gz)
	dist/env/bin/$(PIP_INSTALL) --no-deps --force-reinstall dist/*.whl
	$(BIN)/python tests/reuse_kernels.py dist/env/bin/python
	mkdir dist/try
	cd dist/try && ../env/bin/python -P ../../tests/installed.py
	cd dist/try && ../env/bin/cleargs synth capture --protocol mixed --frames 8 --size 240x136
	cd dist/try && ../env/bin/cleargs run capture -o run --recipe smoke
	cd dist/try && ../env/bin/cleargs verify run

dist: .venv/dev.stamp
	rm -rf dist build
	$(BIN)/python -m build --quiet --no-isolation --outdir dist .
	rm -rf build

docs: .venv/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

drill: .venv/test.stamp
	$(BIN)/python tests/drill.py
	$(BIN)/python tests/planted_links.py --links 1000

fuzz: .venv/test.stamp
	CLEARGS_FUZZ=2000 $(BIN)/python -m pytest tests/test_fuzz.py --hypothesis-seed=$(or $(SEED),0)

# A script ends with 2 where it cannot be tried; this is not a failure.
findings:
	@changed=; for script in findings/*.sh; do echo "== $$script"; $$script || [ $$? = 2 ] || changed="$$changed $$script"; done; \
	if [ -n "$$changed" ]; then echo "changed:$$changed"; exit 1; fi

test-gpu-kernels: .venv/cuda.stamp
	TRITON_INTERPRET=1 $(BIN)/python -m pytest -m gpu $(PARALLEL) tests/gpu tests/splat tests/formation

lint: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/mypy cleargs stages benchmarks tools
	$(BIN)/python -m tools.prose
	$(BIN)/python -m tools.prose README.md CHANGELOG.md CONTRIBUTING.md docs findings

convert-env: .venv-convert/stamp

test-convert: convert-env
	.venv-convert/bin/python -m pytest tests/tools/test_convert_models.py

browser: .venv/browser.stamp

oracles: .oracles/stamp

# Installed again each time, because npm does not replace files that were deleted below.
.oracles/stamp: Makefile
	rm -rf .oracles
	npm install --prefix .oracles --ignore-scripts --silent \
		@playcanvas/splat-transform@3.7.0 gltf-validator@2.0.0-dev.3.10 @adobe/spz@0.2.3 @sparkjsdev/spark@2.2.0 three@0.180.0 fzstd@0.1.1
	# Most of the files are maps, debug builds, examples and the GPU drivers of other machines.
	cd .oracles/node_modules && find playcanvas/build/playcanvas?* ! -name playcanvas.min.mjs -delete && \
		find three/examples -type f ! -name Pass.js ! -name OrbitControls.js -delete && rm -rf three/src @sparkjsdev/spark/dist/*.cjs.* && \
		find . -name '*.map' -delete && find webgpu/dist \
		-name '*.node' ! -name "$$(node -p 'process.platform')-$$(node -p 'process.arch').*" -delete
	# nerfstudio's parser, and what its import needs in addition to our own packages.
	$(PYTHON) -m pip install --disable-pip-version-check $(INSTALL_OPTIONS) --quiet --no-deps --target .oracles/python \
		nerfstudio==1.1.5 absl-py==2.5.1 docstring-parser==0.18.0 jaxtyping==0.3.11 msgspec==0.22.0 shtab==1.13.0 \
		tensorboard==2.21.0 tyro==1.0.17 viser==1.1.1 wadler-lindig==0.1.8 websockets==17.4 zstandard==0.25.0
	touch $@

# A separate environment, because Snakemake needs other versions of numpy and pandas.
cluster: .venv-cluster/stamp

.venv-cluster/stamp: requirements.lock
	$(PYTHON) -m venv .venv-cluster
	$(call install,.venv-cluster,cluster)
	touch $@

.venv/bin/python:
	$(PYTHON) -m venv .venv

# Sections of requirements.lock that .venv needs, by purpose.
NEEDS_demo := base
NEEDS_test := base test
NEEDS_browser := base test browser
NEEDS_cuda := base test cuda
NEEDS_dev := base test dev
NEEDS_docs := base docs

.venv/%.stamp: $(PINS) | .venv/bin/python
	$(call install,.venv,$(NEEDS_$*),-e .)
	touch $@

# All but the GPU's at once, which is faster than one after the other.
.venv/all.stamp: $(PINS) | .venv/bin/python
	$(call install,.venv,base test browser dev docs,-e .)
	touch $(foreach purpose,demo test browser dev docs all,.venv/$(purpose).stamp)

.venv-convert/stamp: $(PINS)
	$(PYTHON) -m venv .venv-convert
	$(call install,.venv-convert,convert,-e .,torchvision)
	touch $@

clean:
	rm -rf demo build dist site *.egg-info .venv .venv-convert .venv-cluster .oracles
