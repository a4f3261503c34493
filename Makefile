# The only commands anyone needs. Each sets up its own virtual environment on a fresh machine with Python >= 3.11.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Tests run in two processes: the boards and machines this is made for have at least two cores.
JOBS ?= 2

.PHONY: help demo test check format bench campaign deb deb-test clean

help:
	@echo 'make demo    watch a virtual aircraft being calibrated (about a minute)'
	@echo 'make test    run all tests (about 7 minutes on two cores)'
	@echo 'make check   formatting, lint, types, import directions'
	@echo 'make format  put the code into the one format'
	@echo 'make bench   speed, as ratios within one run'
	@echo 'make campaign  every fault in every phase of a calibration (about 6 minutes on two cores)'
	@echo 'make deb     a Debian package for machines like this one, in dist/'
	@echo 'make deb-test  try that package in a clean root (as root; a minute or two)'
	@echo 'make clean   remove what the other targets made'

$(VENV)/.run: pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo 'Python 3.11 or newer is needed; name one with PYTHON=...' >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) \
		|| { echo 'The venv module is needed: sudo apt install python3-venv' >&2; exit 2; }
	@echo 'Installing what the companion needs into $(VENV) (once)...'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.run
	@echo 'Installing what the tests need into $(VENV) (once)...'
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(VENV)/.run
	@$(BIN)/python -m sim demo

test: $(VENV)/.dev
	@$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal

check: $(VENV)/.dev
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

format: $(VENV)/.dev
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: $(VENV)/.dev
	@$(BIN)/python -m tests.bench

# SEED= plays it with other dice.
SEED ?= 7

campaign: $(VENV)/.dev
	@$(BIN)/python -m tests.campaign --seed $(SEED) --jobs $(JOBS)

# With Debian's Python, whatever PYTHON is: the package runs with it. EXTRAS= puts neither MQTT nor recording in.
EXTRAS ?= mqtt,recording
SYSTEM_PYTHON ?= /usr/bin/python3

deb:
	@rm -f dist/companion_*.deb
	@$(SYSTEM_PYTHON) packaging/deb/build_deb.py --python $(SYSTEM_PYTHON) --extras "$(EXTRAS)"

deb-test: deb
	@packaging/deb/try_in_clean_root.sh dist/companion_*.deb

clean:
	rm -rf build dist $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
