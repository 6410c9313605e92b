# On a fresh machine each target sets itself up: .venv with the pinned versions, then hapticdb.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: demo test test-plain lint types bench wheel pins clean

demo: $(READY)
	$(BIN)/hapticdb demo demo

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

# Open3D stands beside in the voxelizing benchmark when it is installed:
#   pip install open3d   (needs the system's libusb-1.0)
bench: $(READY)
	$(BIN)/pytest benchmarks --benchmark-enable --benchmark-only --benchmark-columns=median,min,iqr,rounds

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
	rm -rf .venv dist demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
