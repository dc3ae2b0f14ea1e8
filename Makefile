# `make demo` and `make test` work on a fresh clone: all they need is Python 3.11, 3.12 or 3.13 with its venv module.
PYTHON ?= python3
BIN := .venv/bin
RUNTIME := .venv/.runtime
READY := .venv/.ready

.PHONY: demo test check check-long verify stability bench faults tables docs clean

demo: $(RUNTIME)
	$(BIN)/jaxunshear run experiments/demo.py

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not long"

check: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

# Compiled as users have it; `make test` saves XLA's time.
check-long: $(READY)
	XLA_FLAGS= $(BIN)/python -m pytest -m long

# The simulator against closed forms and other solvers; contacts, networks and trainings at their extremes.
verify stability: $(READY)
	$(BIN)/python -m verification $@

# Error against run time: make bench NAME=sim; python -m benchmarks --help lists the names.
bench: $(READY)
	$(BIN)/python -m benchmarks $(NAME)

# Hours at its full size; needs a C compiler, and the right to mount for the rows of full and read-only file systems.
faults: $(READY)
	$(BIN)/python -m tests.faults --json docs/results/faults.json $(FAULTS)

# From docs/results into README and docs/*.md, each with its files, their commands and commits.
tables: $(READY)
	$(BIN)/python -m docs.make_tables

# Checks the prose; then pages in site/: open site/index.html. Their search needs a server: python -m http.server -d site
docs: $(READY)
	$(BIN)/python -m docs.prose
	$(BIN)/python docs/make_diagrams.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# Results (runs/) and data sets (datasets/) are kept.
clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache .mypy_cache *.egg-info
	find jaxunshear verification benchmarks data_specs tests experiments -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is written last: an install that was interrupted is done again. Byte code is compiled on all cores, without
# the tests of packages; pip compiles all of it on one core.
$(RUNTIME): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
		{ echo "Python 3.11, 3.12 or 3.13 is needed; name one: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 2; }
	@echo "Setting up .venv; the installs take a few minutes."
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --constraint constraints.txt --editable .
	$(BIN)/python -m compileall -qq -j 0 -x /tests/ .venv/lib || true
	touch $(RUNTIME)

# Tools for tests, checks and documents.
$(READY): $(RUNTIME)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(READY)
