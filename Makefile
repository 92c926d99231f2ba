# Two commands set everything up from a bare Python 3.11 or newer: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test soak benchmarks lint clean

$(VENV)/.run: pyproject.toml constraints.txt
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" || { echo "thermofuse needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.test: $(VENV)/.run
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[test]"
	@touch $@

# The main job on a campaign of the twin: simulate, run, print the summary and the path of report.html.
demo: $(VENV)/.run
	rm -rf build/demo
	$(BIN)/thermofuse simulate data/demo.toml --out build/demo/campaign
	$(BIN)/thermofuse run build/demo/campaign/campaign.toml --out build/demo/results

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# One process per core, each with one thread for linear algebra: more would only wait for one another.
test: lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest --numprocesses 2 --dist loadfile

# Long simulations: the figures that the documentation quotes come from here.
soak: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest tests/soak -m slow -s

# Speeds, as ratios against named peers measured in the same run.
benchmarks: $(VENV)/.test
	$(BIN)/pytest tests/benchmarks -m "slow or not slow" --benchmark-enable -s

clean:
	rm -rf build $(VENV)
