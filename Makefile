# On a fresh machine each target sets itself up: .venv with the pinned versions, then hapticdb.
# The demo installs what a user needs (USER), everything else the developers' tools, too (READY).
PYTHON ?= python3
BIN := .venv/bin
USER := .venv/user
READY := .venv/ready
PIP := $(BIN)/pip install --quiet --disable-pip-version-check
# Three tests run on each two processors: most of them wait for servers half of their time.
PYTEST := $(BIN)/pytest tests --numprocesses=$$(( ($$(nproc) * 3 + 1) / 2 )) --dist=worksteal

.PHONY: demo test test-long test-browser test-all test-plain lint types figures peers realtime feel scale paths clashes waits site release pins clean

demo: $(USER)
	$(BIN)/hapticdb demo demo

# what a person runs ten times a day: minutes
test: $(READY)
	$(PYTEST) -m "not long and not browser" $(ARGS)

# Kills, rights, recovery and every page's commands; of each long loop a dozen steps drawn at random.
test-long: $(READY)
	$(PYTEST) -m long $(ARGS)

# Chromium draws with all processors: beside other tests its pages would be too slow.
test-browser: $(READY)
	$(BIN)/pytest tests -m browser $(ARGS)

# Every step of every loop, on every PostgreSQL: before a release, not in CI.
test-all: $(READY) test-browser
	$(PYTEST) --every-step -m "not browser" $(ARGS)

# the kernels as plain Python: what the JIT must not change
test-plain: $(READY)
	NUMBA_DISABLE_JIT=1 $(BIN)/pytest tests/kernels --numprocesses=auto --dist=worksteal

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy
	$(BIN)/mypy benchmarks examples

# The measurements behind docs/; ARGS=--quick for a first look, into results-quick/. Real assemblies are read
# from the folder that HAPTICDB_TEST_DATA names; without it the sample car stands in for them.
figures realtime feel paths clashes waits: export HAPTICDB_TEST_DATA ?= $(wildcard ../shared/data)

# docs/evaluation.md, on SQLite and every PostgreSQL found: a quarter of an hour
figures: $(READY)
	$(BIN)/python benchmarks/figures.py $(ARGS)

# its growth from 1.4 million to 1.4 billion voxels: five minutes, 10 GB of disk
scale: $(READY)
	$(BIN)/python benchmarks/scale.py $(ARGS)

# docs/realtime.md: frames in memory beside a dense bitmap, sessions beside an empty loop, and on a server far away:
# six minutes
realtime: $(READY)
	$(BIN)/python benchmarks/in_real_time.py $(ARGS)
	$(BIN)/python benchmarks/far_away.py $(ARGS)

# docs/feel.md: how good the forces feel: ten minutes
feel: $(READY)
	$(BIN)/python benchmarks/feeling.py $(ARGS)

# the evaluation's speed: poses beside python-fcl, coal and Open3D: five minutes
paths: $(READY) .venv/figures
	$(BIN)/python benchmarks/batches.py $(ARGS)

# docs/clashes.md: every pair of 4,284 parts, and of four scenes
clashes: $(READY)
	$(BIN)/python benchmarks/clashes.py

# what people wait for: every verb first and again, 20 pulls, clashes, hands at 1 and 5 kHz: eight minutes
waits: $(READY) clashes
	$(BIN)/python benchmarks/waits.py $(ARGS)
	$(BIN)/python benchmarks/periods.py

peers: .venv/figures

.venv/figures: requirements/figures.txt $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --requirement requirements/figures.txt
	touch $@

# the pages and the API as a site, build/site; a warning is an error
site: .venv/release
	$(BIN)/sphinx-build --fail-on-warning --keep-going --fresh-env --quiet -c docs -d build/doctrees . build/site

# sdist, and the wheel made of it, tried in an empty environment; a wheel for each of several Pythons:
# PYTHONS="python3.11 python3.13"
release: PYTHONS ?= $(PYTHON)
release: .venv/release
	rm -rf dist
	$(BIN)/python -m build --no-isolation
	$(BIN)/twine check --strict dist/*
	for python in $(PYTHONS); do .ci/try "$$python" || exit; done

.venv/release: requirements/release.txt $(READY)
	$(PIP) --requirement requirements/release.txt
	touch $@

# newest versions that fit pyproject.toml, in an environment of their own
pins:
	rm -rf .venv-pins
	$(PYTHON) -m venv .venv-pins
	.venv-pins/bin/pip install --upgrade "pip>=25.1"
	.venv-pins/bin/pip install ".[view]"
	head -1 requirements/user.txt > .venv-pins/user.txt
	.venv-pins/bin/pip freeze --exclude hapticdb >> .venv-pins/user.txt
	.venv-pins/bin/pip install ".[step,ifc,volume,pointcloud,postgres,cluster,extract,parquet,machines]" --group dev
	head -1 requirements/dev.txt > .venv-pins/dev.txt
	.venv-pins/bin/pip freeze --exclude hapticdb | grep -vxFf .venv-pins/user.txt >> .venv-pins/dev.txt
	.venv-pins/bin/pip install --group release
	head -1 requirements/release.txt > .venv-pins/release.txt
	.venv-pins/bin/pip freeze --exclude hapticdb | grep -vxFf .venv-pins/user.txt -f .venv-pins/dev.txt >> .venv-pins/release.txt
	mv .venv-pins/user.txt .venv-pins/dev.txt .venv-pins/release.txt requirements/
	rm -rf .venv-pins

# kernels are compiled beside the rest of the installation; Python compiles a module when it is first imported
$(USER): requirements/user.txt pyproject.toml
	$(PYTHON) -m venv .venv
	grep -E "^(llvmlite|numba|numpy)==" requirements/user.txt > .venv/kernels.txt
	$(PIP) --no-compile --requirement .venv/kernels.txt
	PYTHONPATH=src $(BIN)/python -c "from hapticdb.kernels._sets import fitting_set; fitting_set('frames')" & \
	$(PIP) --no-compile --requirement requirements/user.txt && \
	$(PIP) --no-compile --constraint requirements/dev.txt hatchling editables && \
	$(PIP) --no-deps --no-build-isolation --editable . && wait
	touch $(USER)

$(READY): requirements/dev.txt $(USER)
	$(PIP) --requirement requirements/dev.txt
	touch $(READY)

clean:
	rm -rf .venv build dist demo results-quick .pytest_cache .mypy_cache .ruff_cache .hypothesis
