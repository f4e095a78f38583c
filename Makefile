# `make demo` and `make test` need python3 and make only: they set up .venv, install, and run.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test bench bench-check faults lint format notebooks clean

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

demo: $(VENV)/.installed
	$(BIN)/neuroslam demo --out demo

test: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest -n 2 --dist worksteal

bench: $(VENV)/.installed
	$(BIN)/python -m benchmarks.table

# Fails if a row of the table takes 15 % longer, in Y, than in benchmarks/last.json.
bench-check: $(VENV)/.installed
	$(BIN)/python -m benchmarks.table --check

# Kills, full disks, two writers, damaged and crafted inputs: the tables of docs/reliability.md.
faults: $(VENV)/.installed
	$(BIN)/python -m benchmarks.faults
	$(BIN)/python -m benchmarks.fuzz

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Notebooks are kept as text: the .py is the source, the .ipynb is made from it.
notebooks: $(VENV)/.installed
	$(BIN)/jupytext --update --to notebook notebooks/*.py

clean:
	rm -rf $(VENV) demo out .pytest_cache .ruff_cache .hypothesis
