# On a fresh machine each target sets itself up: .venv with the pinned versions, then hapticdb.
# The demo installs what a user needs (USER), everything else the developers' tools, too (READY).
PYTHON ?= python3
BIN := .venv/bin
USER := .venv/user
READY := .venv/ready
PIP := $(BIN)/pip install --quiet --disable-pip-version-check
PYTEST := $(BIN)/pytest tests --numprocesses=auto --dist=worksteal

.PHONY: demo test test-long test-browser test-all test-plain lint types bench figures peers realtime feel scale paths wheel pins clean

demo: $(USER)
	$(BIN)/hapticdb demo demo

# what a person runs ten times a day: minutes
test: $(READY)
	$(PYTEST) -m "not long and not browser" $(ARGS)

# Kills, rights, recovery and every page's commands; of each long loop a dozen steps drawn at random.
# Three tests run on each two processors: most of them wait for servers half of their time.
test-long: $(READY)
	$(PYTEST) --numprocesses=$$(( ($$(nproc) * 3 + 1) / 2 )) -m long $(ARGS)

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
	$(BIN)/mypy benchmarks

# Open3D stands beside in the voxelizing benchmark where 'make figures' or 'make peers' has run.
bench: $(READY)
	$(BIN)/pytest benchmarks --benchmark-enable --benchmark-only --benchmark-columns=median,min,iqr,rounds

# The evaluation in docs/evaluation.md: a quarter of an hour; ARGS=--quick for two minutes.
# PostgreSQL 15 and PostGIS or pgpointcloud, where they are installed, take part (README.md).
# Real assemblies for Table 1 and voxelizing are read from the folder that HAPTICDB_TEST_DATA names.
figures: export HAPTICDB_TEST_DATA ?= $(wildcard ../shared/data)
figures: $(READY) .venv/figures
	$(BIN)/python benchmarks/figures.py $(ARGS)

# Frames and bytes at 1.4 million to 1.4 billion voxels: five minutes, 10 GB of disk.
scale: $(READY)
	$(BIN)/python benchmarks/scale.py --report docs/evaluation.md $(ARGS)

# Frames in memory beside a dense bitmap, and sessions beside an empty loop: three minutes.
realtime: $(READY)
	$(BIN)/python benchmarks/in_real_time.py $(ARGS)

# Poses a second, by batches, beside python-fcl, coal and Open3D, over the vintage car where
# HAPTICDB_TEST_DATA has it, else over the sample; and large tools beside the flat loop. A quarter of an
# hour.
paths: export HAPTICDB_TEST_DATA ?= $(wildcard ../shared/data)
paths: $(READY) .venv/figures
	$(BIN)/python benchmarks/batches.py
	$(BIN)/python benchmarks/large_shells.py

# How good the forces feel, under both laws (docs/feel.md): a quarter of an hour; ARGS=--quick for two
# minutes. The walk is over the vintage car where HAPTICDB_TEST_DATA has it, else over the sample.
feel: export HAPTICDB_TEST_DATA ?= $(wildcard ../shared/data)
feel: $(READY)
	$(BIN)/python benchmarks/feeling.py $(ARGS)

peers: .venv/figures

.venv/figures: requirements/figures.txt $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --requirement requirements/figures.txt
	touch $@

wheel: $(READY)
	rm -rf dist
	$(BIN)/python -m build --wheel --no-isolation

# newest versions that fit pyproject.toml, in an environment of their own
pins:
	rm -rf .venv-pins
	$(PYTHON) -m venv .venv-pins
	.venv-pins/bin/pip install --upgrade "pip>=25.1"
	.venv-pins/bin/pip install .
	head -1 requirements/user.txt > .venv-pins/user.txt
	.venv-pins/bin/pip freeze --exclude hapticdb >> .venv-pins/user.txt
	.venv-pins/bin/pip install ".[step,pointcloud,postgres,view,extract]" --group dev
	head -1 requirements/dev.txt > .venv-pins/dev.txt
	.venv-pins/bin/pip freeze --exclude hapticdb | grep -vxFf .venv-pins/user.txt >> .venv-pins/dev.txt
	mv .venv-pins/user.txt .venv-pins/dev.txt requirements/
	rm -rf .venv-pins

$(USER): requirements/user.txt pyproject.toml
	$(PYTHON) -m venv .venv
	$(PIP) --requirement requirements/user.txt
	$(PIP) --no-deps --editable .
	touch $(USER)

$(READY): requirements/dev.txt $(USER)
	$(PIP) --requirement requirements/dev.txt
	touch $(READY)

clean:
	rm -rf .venv dist demo results-quick .pytest_cache .mypy_cache .ruff_cache .hypothesis
