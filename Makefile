# Everything here runs in the virtual environment .venv, which `setup` makes; on a bare machine each target makes it first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One thread a process: torch's OpenMP threads spin and slow each other down on busy or small machines.
TEST_WORKERS ?= 2

.PHONY: setup demo train test lint bench docs clean

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
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TEST_WORKERS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/observation.py --out build/observation.json
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/association.py --out build/association.json

docs: $(STAMP)
	OMP_NUM_THREADS=1 NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf build dist site demo runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find nolbo_ppl tests benchmarks notebooks -name __pycache__ -type d -prune -exec rm -rf {} +
