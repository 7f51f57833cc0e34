# Two commands on a fresh machine with Python 3.11 or newer: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
PLAIN := .venv-plain
BIN := $(VENV)/bin
DOCS := .venv-docs
READY := $(VENV)/ready
TESTED := $(VENV)/ready-to-test

.PHONY: demo docs test test-all lint types suite clean

demo: $(READY)
	$(BIN)/reseau demo demo

# The types are checked beside the tests: without its cache, mypy keeps one core busy for a minute.
test: lint
	$(MAKE) --no-print-directory --jobs=2 types suite

# With the studies, fuzz and kills that are marked `study`: many minutes.
test-all: lint $(DOCS)/ready
	$(MAKE) --no-print-directory --jobs=2 types suite MARKED="study or not study"

# Byte code is kept, also where the environment forbids it: every process that a test starts would compile the program
# anew.
suite: export PYTHONDONTWRITEBYTECODE =
suite: $(TESTED) $(PLAIN)/ready
	$(BIN)/python -m pytest -n 2 --dist loadgroup --no-loadscope-reorder $(if $(MARKED),-m "$(MARKED)")

lint: $(TESTED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(TESTED)
	$(BIN)/mypy

# What running needs: for a user, and in a second environment for the tests of what a user has, to which nothing is added.
# The second lock file's package carries the networks that read writing; what it asks for itself would replace OpenCV.
$(READY) $(PLAIN)/ready: %/ready: requirements.lock requirements-no-deps.lock pyproject.toml compiled/kernels.c
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "reseau needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Say which one to use: make PYTHON=python3.12")'
	$(PYTHON) -m venv $*
	$*/bin/pip install --quiet --requirement requirements.lock
	$*/bin/pip install --quiet --no-deps --requirement requirements-no-deps.lock
	$*/bin/pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

# What testing needs beside it: the checkers, the extras of every command, and what stands in for servers.
$(TESTED): $(READY) requirements-test.lock
	$(BIN)/pip install --quiet --requirement requirements-test.lock
	touch $@

# The site of the documentation, in build/site: open its index.html. Nothing is fetched while it is built or read.
docs: $(DOCS)/ready
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict --quiet
	@echo build/site/index.html

$(DOCS)/ready: requirements-docs.lock
	$(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/pip install --quiet --requirement requirements-docs.lock
	touch $@

clean:
	rm -rf $(VENV) $(PLAIN) $(DOCS) demo build *.egg-info .mypy_cache .ruff_cache .pytest_cache
