# Everything here runs in the virtual environment .venv, which `setup` makes; on a bare machine each target makes it first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One thread a process: torch's OpenMP threads spin and slow each other down on busy or small machines.
TEST_WORKERS ?= 2
# Time of `make fuzz`; hours find more.
FUZZ_SECONDS ?= 600
# Kills, signals and full disks of `make faults`.
FAULTS ?= 100

.PHONY: setup demo train test test-slow lint wheel bench bench-gate docs clean fuzz faults test-lowest test-newest audit

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/nolbo demo --out demo

train: $(STAMP)
	$(BIN)/nolbo train --preset nano --out runs/nano --count 1024 --single-steps 0 --shape-steps 150 --scene-steps 400

test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TEST_WORKERS) -m "not slow"

# Those of more than ten seconds: notebooks, documents, whole runs, two processes.
test-slow: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TEST_WORKERS) -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

# The built wheel in an environment that has nothing else: what a user gets who never sees this folder.
wheel: $(STAMP)
	rm -rf dist build/bare
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(PYTHON) -m venv build/bare
	build/bare/bin/python -m pip install --quiet -c constraints.txt dist/*.whl
	cd build && bare/bin/nolbo simulate --out bare/world --frames 40 --laps 1 --radius 15 --world.objects 12
	cd build && bare/bin/nolbo slam --odometry bare/world/odometry.txt --observations bare/world/observations.jsonl \
		--truth bare/world/truth.txt --out bare/map
	test -s build/bare/map/summary.json
	build/bare/bin/python tools/bill_of_materials.py --wheel dist/*.whl --out dist/bill-of-materials.cdx.json

# The lowest versions that pyproject.toml allows, and the newest there are: each in an environment of its own, the part of the
# tests that goes through every dependency.
DEPENDENCY_TESTS := tests/geometry tests/io tests/structures tests/inference/slam/test_solve.py tests/models/distributions

test-lowest:
	$(PYTHON) -m venv build/lowest
	$(PYTHON) tools/lower_bounds.py > build/lowest.txt
	build/lowest/bin/python -m pip install --quiet -c build/lowest.txt -e . pytest hypothesis mpmath beartype
	OMP_NUM_THREADS=1 build/lowest/bin/python -m pytest -q -W default $(DEPENDENCY_TESTS)

test-newest:
	$(PYTHON) -m venv build/newest
	build/newest/bin/python -m pip install --quiet --upgrade -e . pytest hypothesis mpmath beartype
	OMP_NUM_THREADS=1 build/newest/bin/python -m pytest -q $(DEPENDENCY_TESTS)

# Known vulnerabilities of what a user gets; status 3 where no advisory service answers.
audit: wheel
	$(PYTHON) -m venv build/audit
	build/audit/bin/python -m pip install --quiet pip-audit
	build/audit/bin/python tools/audit.py --path build/bare/lib/python3.*/site-packages

bench: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/observation.py --out build/observation.json
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/association.py --out build/association.json

bench-gate: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/gate.py

fuzz: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/fuzz.py --seconds $(FUZZ_SECONDS) --out build/fuzz.json

faults: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/faults.py --count $(FAULTS) --out build/faults.json

docs: $(STAMP)
	OMP_NUM_THREADS=1 NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf build dist site demo runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find nolbo_ppl tests benchmarks notebooks -name __pycache__ -type d -prune -exec rm -rf {} +
