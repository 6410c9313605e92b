# On a fresh machine each target sets itself up: .venv with the pinned versions, then hapticdb.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: demo test test-plain lint types bench figures peers realtime scale wheel pins clean

demo: $(READY)
	$(BIN)/hapticdb demo demo

# HYPOTHESIS_PROFILE=thorough make test: 200 examples a property instead of 25
test: $(READY)
	$(BIN)/pytest tests

# the kernels as plain Python: what the JIT must not change
test-plain: $(READY)
	NUMBA_DISABLE_JIT=1 $(BIN)/pytest tests/kernels

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
	.venv-pins/bin/pip install ".[step,pointcloud,postgres]" --group dev
	echo "# Everything that make test, make demo and .ci/run install; renewed by 'make pins'." > requirements/dev.txt
	.venv-pins/bin/pip freeze --exclude hapticdb >> requirements/dev.txt
	rm -rf .venv-pins

$(READY): requirements/dev.txt pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements/dev.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $(READY)

clean:
	rm -rf .venv dist demo results-quick .pytest_cache .mypy_cache .ruff_cache .hypothesis
