# Two commands set everything up from a bare Python 3.11 or newer: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
export PIP_DISABLE_PIP_VERSION_CHECK = 1
# The tests start the program a hundred times; without its bytecode each would compile all of it.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test tests readme quick docs screenshots pictures soak benchmarks speeds lint mutants audit lock kernels clean

$(BIN)/python:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" || { echo "thermofuse needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.run: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .
	@touch $@

# pip would compile with one processor, and a third of it for what no test imports: the tests of the libraries, and what only moto needs.
$(VENV)/.test: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --editable ".[test]"
	$(BIN)/python -m compileall -qq -j 0 -x '/(tests?|sympy|mpmath|networkx|cfnlint)/' $(VENV)/lib || true
	@touch $(VENV)/.run $@

$(VENV)/.docs: $(VENV)/.run
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[docs]"
	@touch $@

# The main job on a campaign of the twin: simulate, run, print the summary and the path of report.html.
demo: $(VENV)/.run
	rm -rf build/demo build/demo-truth
	$(BIN)/thermofuse demo build/demo

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Types are checked beside the tests, as that takes one processor for a minute in a fresh clone.
test: $(VENV)/.test
	@$(MAKE) --jobs 2 lint tests

# Four processes for two cores, because a test with a browser or a control waits half of its time; files in the order of tests/conftest.py,
# which leaves the short ones to the end. One thread each for linear algebra: more would only wait for one another.
tests: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest --numprocesses 4 --dist loadfile --no-loadscope-reorder

# README's lines and Python and the cells of the tutorials, in a copy of the last commit with the environment that README's line makes.
readme:
	rm -rf build/readme && mkdir -p build/readme && git archive HEAD | tar -x -C build/readme
	cd build/readme && $(PYTHON) tests/readme.py

# What shows within a minute whether a change broke something; `make test` runs everything.
quick: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -m 'not slow and not chain and not browser and not long' --numprocesses 2 --dist loadfile

# The documentation site, tutorials run, in build/docs. Needs no network; measured files that cannot be had leave their page unexecuted, and it says so.
docs: $(VENV)/.docs $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/sphinx-build --fail-on-warning --keep-going --nitpicky --quiet docs build/docs
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -q -m docs tests/test_documentation_site.py
	@echo "documentation: $(CURDIR)/build/docs/index.html"

# The pictures of README and documentation, from the demo's report in a headless Chromium.
screenshots: $(VENV)/.test demo
	$(BIN)/python docs/pictures/take.py build/demo/results build/demo docs/pictures

# Whether each of them still shows what its page says.
pictures: $(VENV)/.test demo
	$(BIN)/python docs/pictures/take.py build/demo/results build/demo docs/pictures --check

# Long simulations: the figures that the documentation quotes come from here.
soak: $(VENV)/.test
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest tests --ignore tests/benchmarks -m slow -s

# Speeds, as ratios against named peers measured in the same run.
benchmarks: $(VENV)/.test
	$(BIN)/pytest tests/benchmarks -m "slow or not slow" --benchmark-enable -s

# The same of an earlier state beside today's, with the times of the commands, as one table: make speeds BEFORE=<commit> (half an hour).
speeds: $(VENV)/.test
	rm -rf build/before && mkdir -p build/before && git archive $(BEFORE) | tar -x -C build/before
	$(BIN)/python tests/benchmarks/beside_earlier.py build/before

# Share of small changes to a module (signs, limits, comparisons) that its tests notice, on a copy of what is staged or committed; fails
# below 90 %. A sample takes some minutes: make mutants MODULE=fusion/analysis/attribution/places.py SAMPLE=60 SEED=2; SAMPLE=0 takes every change.
MODULE ?= fusion/analysis/drift_model/evaluation.py
SAMPLE ?= 60
SEED ?= 1
mutants: $(VENV)/.test
	$(BIN)/pip install --quiet "cosmic-ray>=8.4"
	rm -rf build/mutants && git checkout-index --all --prefix=build/mutants/
	cd build/mutants && PYTHONPATH=$(CURDIR)/build/mutants OPENBLAS_NUM_THREADS=1 \
	  $(abspath $(BIN))/python tests/mutants.py $(MODULE) --sample $(SAMPLE) --seed $(SEED)

# What the program needs at run time: known vulnerabilities (needs a network), licences, and a bill of materials (CycloneDX), in build/audit.
audit:
	rm -rf build/audit && $(PYTHON) -m venv build/audit/environment && $(PYTHON) -m venv build/audit/tools
	build/audit/environment/bin/pip install --quiet --constraint constraints.txt .
	build/audit/tools/bin/pip install --quiet "pip-audit>=2.9" "pip-licenses>=5" "cyclonedx-bom>=7"
	build/audit/tools/bin/pip-licenses --python build/audit/environment/bin/python --from=mixed --with-urls --format=csv --output-file build/audit/licences.csv
	build/audit/tools/bin/cyclonedx-py environment --pyproject pyproject.toml --output-format JSON --output-file build/audit/sbom.json build/audit/environment/bin/python
	build/audit/environment/bin/pip freeze --exclude thermofuse > build/audit/pinned.txt
	build/audit/tools/bin/pip-audit --strict --no-deps --disable-pip --requirement build/audit/pinned.txt

# Name, version and SHA-256 of every file that this machine and this Python install, in build/requirements.lock; see CONTRIBUTING.md.
lock: $(VENV)/.run
	mkdir -p build
	$(BIN)/pip install --quiet --dry-run --ignore-installed --report build/files.json --constraint constraints.txt .
	$(BIN)/python -c "import json; \
	  found = [one for one in json.load(open('build/files.json'))['install'] if 'archive_info' in one['download_info']]; \
	  print(*sorted('{name}=={version} --hash=sha256:{sha256}'.format(**one['metadata'], **one['download_info']['archive_info']['hashes']) \
	  for one in found), sep='\n')" > build/requirements.lock

# Compiled kernels once as plain Python, where array bounds are checked and coverage counts their lines: those that are quick enough for it.
kernels: $(VENV)/.test
	NUMBA_DISABLE_JIT=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest tests/fusion/analysis/alignment/test_readings.py tests/thermography/io/test_png16.py \
	  tests/interferometry/drift/test_kalman.py

clean:
	rm -rf build $(VENV)
