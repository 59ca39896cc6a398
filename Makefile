# make demo: everything from nothing to pictures. make check test: what CI runs. make chaos: faults (docs/guarantees.md).
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin

# make quick: unit tests that are not slow, in about a minute.
.PHONY: venv demo quick test check chaos fuzz soak bench

venv: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: venv
	$(BIN)/sitegrid demo --web

quick: venv
	$(BIN)/python -m pytest --quiet --numprocesses auto -m "not slow and not processes" tests/unit

test: venv
	$(BIN)/python -m pytest --quiet --numprocesses auto --dist worksteal

check: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

chaos: venv
	$(BIN)/python -m tests.chaos

fuzz: venv
	$(BIN)/python -m tests.fuzz --seconds 300

soak: venv
	$(BIN)/python -m tests.soak --minutes 60 --speed 30

bench: venv
	$(BIN)/python -m benchmarks merge
	$(BIN)/python -m benchmarks live
	$(BIN)/python -m benchmarks query
	$(BIN)/python -m benchmarks memory
	$(BIN)/python -m benchmarks ingest
	$(BIN)/python -m benchmarks sim
	$(BIN)/python -m benchmarks filter
