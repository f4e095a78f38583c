# `make demo` and `make test` need python3 and make only: they set up .venv, install, and run.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test bench bench-check faults lint format notebooks docs dist dist-check clean

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

# The site: build/site/html/index.html. No network at build; warnings are errors.
docs: $(VENV)/.docs
	$(BIN)/python docs/site/build.py

# Wheel and sdist of the last commit, from a clean clone.
dist: $(VENV)/.release
	rm -rf build/clone dist
	git clone --quiet . build/clone
	$(BIN)/python -m build --outdir dist build/clone
	$(BIN)/twine check --strict dist/*

# The wheel alone, in a fresh virtual environment: demo, run, report.
dist-check: dist
	rm -rf build/fresh
	$(PYTHON) -m venv build/fresh
	build/fresh/bin/python -m pip install --quiet --constraint constraints.txt dist/*.whl
	cd build/fresh && bin/neuroslam demo --out demo
	cd build/fresh && bin/neuroslam run world:corridor -o first && bin/neuroslam report first

$(VENV)/.docs $(VENV)/.release: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$(patsubst .%,%,$(notdir $@))]"
	touch $@

clean:
	rm -rf $(VENV) build dist demo out .pytest_cache .ruff_cache .hypothesis
