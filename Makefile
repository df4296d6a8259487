# Each target makes what it needs, on a machine that has Python 3.11 or newer and nothing else.
#
#   PYTHON=...      the interpreter to use (default: the newest of python3.13, python3.12, python3.11, python3)
#   ALT_PYTHON=...  the second interpreter for `make test-other`; `none` leaves that run out
#   WORKERS=...     processes that share the tests (0: one, without sharing)
#   DEMO_OUT=...    the folder that `make demo` writes
#   BENCH=...       options of `make bench`, such as "--write", "--large" or "--only calibrate"
#   SUPPLY=...      options of `make supply`, such as "--all", "--python 3.12" or "--only wheel lowest"

PYTHON ?=
ALT_PYTHON ?=
WORKERS ?= 2
DEMO_OUT ?= starcal-demo
BENCH ?=
SUPPLY ?=

BIN := .venv/bin
ALT_BIN := .venv-alt/bin
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# Tests of one file stay in one process, so that what they share is computed once; long files come first.
PYTEST := -m pytest --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder
# What depends on the generation of ArviZ (0.23 with Python 3.11, 1 with 3.12 and newer) or on Python itself: sampling and
# posteriors, run folders, the report, whole runs at the command line, and how the package is put together.
OTHER_TESTS := tests/inference tests/runs tests/presentation/test_report.py tests/cli/test_commands.py tests/cli/test_schemas.py tests/test_project.py

# What is compiled once serves all processes of the tests, and the next run; `make clean` removes it.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-other test-second test-slow supply lint lint-types lint-style docs bench bench-rivals clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: .venv/.installed ## the paper's experiment, from a star catalogue to a finished report
	$(BIN)/starcal-uq demo --out $(DEMO_OUT) --force

test: lint ## linters, types, layers and the fast tests
	$(BIN)/python $(PYTEST) -m "not slow"

test-other: .venv/.made ## fast tests of what depends on Python and ArviZ, on a second interpreter where one is found
	@sh scripts/find_python.sh --other $(BIN)/python "$(ALT_PYTHON)" > .venv/other
	@if [ -s .venv/other ]; then echo "second interpreter: $$(cat .venv/other)"; \
	$(MAKE) --no-print-directory test-second OTHER="$$(cat .venv/other)"; \
	else echo "second interpreter: none, so only one generation of ArviZ is tested"; fi

test-second: .venv-alt/.installed
	$(ALT_BIN)/python $(PYTEST) -m "not slow" $(OTHER_TESTS)
	$(ALT_BIN)/python -m pytest -m slow tests/test_notebook.py::test_the_page_on_own_tools_runs

test-slow: .venv/.installed-test ## the Monte Carlo tests
	$(BIN)/python $(PYTEST) -m slow

supply: .supply/.installed ## what users install: wheel, source distribution, lowest versions and licences, from empty environments
	.supply/bin/python scripts/supply.py $(SUPPLY)

lint: .venv/.installed-test ## style, types and layers
	@$(MAKE) --no-print-directory --jobs=2 lint-types lint-style

lint-types:
	$(BIN)/mypy

lint-style:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

docs: .venv/.installed-docs ## the documentation, into docs/_build/html; a warning, or a word against docs/style.toml, is an error
	$(BIN)/python scripts/prose.py
	$(BIN)/sphinx-build --fail-on-warning --keep-going --fresh-env docs docs/_build/html

bench: .venv/.installed-test ## the package beside its rivals, and with BENCH=--write the tables of the documentation
	$(BIN)/python benchmarks/run.py $(BENCH)

bench-rivals: .bench/.installed ## an environment for the rivals that are not in ours; mrcal comes with the system
	@/usr/bin/python3 -c "import mrcal" 2>/dev/null || echo "mrcal is not there: apt-get install python3-mrcal (Debian, Ubuntu)"

clean: ## remove everything that the other targets made
	rm -rf .venv .venv-alt .supply .bench docs/_build docs/gallery docs/gallery.md docs/notebooks docs/reference/_commands.md docs/reference/_schemas.md docs/reference/api starcal-demo dist
	rm -rf .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- environments ---------------------------------------------------------------------------------------------------
# A stamp is written after its step has succeeded, so an interrupted installation is taken up again.

.venv/.made:
	@python="$$(sh scripts/find_python.sh "$(PYTHON)")" \
	&& echo "making .venv with $$python" \
	&& "$$python" -m venv --clear .venv
	@touch $@

# The build backend is installed first and from the constraints: an isolated build would fetch whatever is newest.
.venv/.installed: .venv/.made pyproject.toml constraints.txt
	@echo "installing starcal_uq and what it needs (a few minutes the first time)"
	@$(BIN)/python $(PIP_INSTALL) hatchling editables
	@$(BIN)/python $(PIP_INSTALL) --no-build-isolation --editable .
	@touch $@

.venv/.installed-test: .venv/.installed
	@echo "installing what the tests need"
	@$(BIN)/python $(PIP_INSTALL) --no-build-isolation --editable ".[test]"
	@touch $@

.venv/.installed-docs: .venv/.installed
	@echo "installing what the documentation needs"
	@$(BIN)/python $(PIP_INSTALL) --no-build-isolation --editable ".[docs]"
	@touch $@

.venv-alt/.made:
	"$(OTHER)" -m venv --clear .venv-alt
	@touch $@

.venv-alt/.installed: .venv-alt/.made pyproject.toml constraints.txt
	@echo "installing starcal_uq and its tests for the second interpreter"
	@$(ALT_BIN)/python $(PIP_INSTALL) hatchling editables
	@$(ALT_BIN)/python $(PIP_INSTALL) --no-build-isolation --editable ".[test]"
	@touch $@

.supply/.installed: .venv/.made constraints.txt
	@.venv/bin/python -m venv --clear .supply
	@.supply/bin/python $(PIP_INSTALL) build packaging uv
	@touch $@

.bench/.installed: .venv/.made benchmarks/rivals.txt benchmarks/cedar.txt
	@echo "installing the rivals of the benchmarks"
	@for name in rivals cedar; do $(BIN)/python -m venv --clear .bench/$$name && .bench/$$name/bin/python -m pip install \
	--quiet --disable-pip-version-check --requirement benchmarks/$$name.txt || exit 1; done
	@touch $@
