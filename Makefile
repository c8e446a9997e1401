# A fresh Debian with git, make and Python 3.11 is enough: each target does its own set-up.
#
#   make demo         simulate a small recording, position it, write a report
#   make test         the tests
#   make check        what every change must pass: format, lint, types, imports, documentation, tests with coverage
#   make bench        short benchmarks against benchmarks/baseline.json
#   make docs         the documentation as a site, in site/
#   make setup        the environment in .venv, from requirements.lock
#   make lock         requirements.lock anew, after a change of pyproject.toml; make check-lock says whether it is due

PYTHON ?= python3
V := .venv
export NO_MKDOCS_2_WARNING := 1
UV := $(V)/bin/uv
LOCKED = $(UV) pip compile -q pyproject.toml --all-extras --group dev --universal \
         --generate-hashes --no-emit-index-url --no-header --no-annotate

.PHONY: setup demo test check bench docs lock check-lock
.DEFAULT_GOAL := test

setup: $(V)/.stamp

$(V)/.stamp: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "trifix needs Python 3.11 or newer; name one with: make PYTHON=python3.11 setup"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "Python's venv module is missing; install it with: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(V)
	$(V)/bin/python -m pip install -q --disable-pip-version-check "$$(sed -n 's/^\(uv==[^ ]*\).*/\1/p' requirements.lock)"
	$(UV) pip install -q -p $(V) --require-hashes -r requirements.lock
	$(UV) pip install -q -p $(V) --no-deps -e .
	touch $@

# The compiled loops are built once and kept; two test processes would otherwise build them twice.
demo: setup
	$(V)/bin/trifix warmup
	rm -rf demo
	$(V)/bin/trifix demo

test: setup
	$(V)/bin/trifix warmup
	$(V)/bin/python -m pytest -q -n 2

check: setup check-lock
	$(V)/bin/ruff format --check .
	$(V)/bin/ruff check .
	$(V)/bin/mypy --strict src
	$(V)/bin/lint-imports
	$(V)/bin/mkdocs build -q --strict
	$(V)/bin/trifix warmup
	$(V)/bin/python -m pytest -q -n 2 --cov --cov-report=term:skip-covered

# Short runs against benchmarks/baseline.json; the long ones are in benchmarks/README.md.
bench: setup
	$(V)/bin/trifix warmup
	$(V)/bin/python benchmarks/bench.py

# The site, in site/; nothing in it is loaded from elsewhere.
docs: setup
	$(V)/bin/mkdocs build -q --strict

# The newest releases that pyproject.toml allows and the lock file does not hold yet change nothing here.
lock: setup
	$(LOCKED) -o requirements.lock

check-lock: setup
	@! grep -nE '://|^-' requirements.lock || { echo "requirements.lock holds addresses; run: make lock"; exit 1; }
	@cp requirements.lock $(V)/lock.tmp && $(LOCKED) -o $(V)/lock.tmp && cmp requirements.lock $(V)/lock.tmp || \
	  { echo "requirements.lock does not follow pyproject.toml; run: make lock"; exit 1; }
