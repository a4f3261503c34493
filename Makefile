# The only commands anyone needs. Each sets up its own virtual environment on a fresh machine with Python >= 3.11.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Tests run in two processes: the boards and machines this is made for have at least two cores. Those of the real clock
# wait more than they work: several at once.
JOBS ?= 2
WAITING ?= 6
# Where it is set, every process of every test compiles the whole program anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo quick test long check format bench accuracy campaign firmware-watch pictures messages deb deb-test lock sbom audit clean

help:
	@echo 'make demo    watch a virtual aircraft being calibrated (about two minutes)'
	@echo 'make quick   unit and property tests without real clock and processes (about a minute on two cores)'
	@echo 'make test    all tests (under seven minutes on two cores); DURATIONS=1 notes how long each takes'
	@echo 'make long    the whole of what make test plays a slice of, with new dice (half an hour and more)'
	@echo 'make check   formatting, lint, types, import directions, sizes'
	@echo 'make format  put the code into the one format'
	@echo 'make bench   speed, as ratios within one run'
	@echo 'make accuracy  how good a calibration is, beside the bound and what else is done (about ten minutes on two cores)'
	@echo 'make campaign  every fault in every phase of a calibration (about 6 minutes on two cores)'
	@echo 'make firmware-watch  SRC=TREE: what of a source tree of ArduPilot or PX4 differs for the companion'
	@echo 'make pictures  those of the documents, from real runs (needs Chromium; about three minutes)'
	@echo 'make messages  docs/messages.md from the catalogue in companion/messages'
	@echo 'make deb     a Debian package for machines like this one, in dist/'
	@echo 'make deb-test  try that package in a clean root (as root; a minute or two)'
	@echo 'make lock    requirements/*.txt anew: every dependency with its hashes (UPGRADE=1: the newest; needs the network)'
	@echo 'make sbom    what the package has of others, as CycloneDX, in dist/ (needs the network)'
	@echo 'make audit   known vulnerabilities of what is in requirements/ (needs the network)'
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

PYTEST = $(BIN)/python -m pytest -q --dist worksteal

quick: $(VENV)/.dev
	@$(PYTEST) -n $(JOBS) --quick

# Both parts always run, and both have to be green. Real autopilots (sitl) want a core of their own. The second part does
# without the plugin of Hypothesis: it reads every source for constants, in every worker.
# The daemon's children have niceness 19: with tests of less, they would starve.
test: $(VENV)/.dev
	@$(PYTEST) -n $(JOBS) -m 'not real_clock or sitl' $(if $(DURATIONS),--write-durations); working=$$?; \
	nice -n 19 $(PYTEST) -p no:hypothesispytest -n $(WAITING) -m 'real_clock and not sitl' $(if $(DURATIONS),--write-durations) && exit $$working

long: $(VENV)/.dev
	@TESTS=long $(PYTEST) -n $(JOBS)

check: $(VENV)/.dev
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/python packaging/sizes.py

format: $(VENV)/.dev
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: $(VENV)/.dev
	@$(BIN)/python -m tests.bench

accuracy: $(VENV)/.run
	@$(BIN)/python -m sim accuracy --jobs $(JOBS)
# SEED= plays it with other dice.
SEED ?= 7

campaign: $(VENV)/.dev
	@$(BIN)/python -m tests.campaign --seed $(SEED) --jobs $(JOBS)

# SRC: a source tree, or a binary that is built already.
firmware-watch: $(VENV)/.dev
	@$(BIN)/python packaging/firmware_watch.py $(SRC)

# Some of them alone: PICTURES='demo page report'.
PICTURES ?=

messages: $(VENV)/.run
	@$(BIN)/python packaging/messages.py > docs/messages.md

pictures: $(VENV)/.dev
	@$(BIN)/python -m tests.pictures $(PICTURES)

# With Debian's Python, whatever PYTHON is: the package runs with it. EXTRAS= puts neither MQTT nor recording in.
EXTRAS ?= mqtt,recording
SYSTEM_PYTHON ?= /usr/bin/python3

deb:
	@rm -f dist/companion_*.deb
	@$(SYSTEM_PYTHON) packaging/deb/build_deb.py --python $(SYSTEM_PYTHON) --extras "$(EXTRAS)"

deb-test: deb
	@packaging/deb/try_in_clean_root.sh dist/companion_*.deb

# What supply chain tools need is theirs alone: nothing of it is in the environment that runs or tests the companion.
TOOLS := $(VENV)-tools
LOCKED := runtime mqtt recording ground fleet dev
UPGRADE ?=
COMPILE = $(TOOLS)/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-header $(if $(UPGRADE),--upgrade)

$(TOOLS)/.made: requirements/tools.txt
	@$(PYTHON) -m venv $(TOOLS)
	@$(TOOLS)/bin/pip install --quiet --disable-pip-version-check --require-hashes -r requirements/tools.txt
	@touch $@

# The extras after dev, which has them all, and with its versions: what is tested is what is installed.
lock: $(TOOLS)/.made
	@$(COMPILE) pyproject.toml --extra dev -o requirements/dev.txt
	@$(COMPILE) pyproject.toml -c requirements/dev.txt --no-annotate -o requirements/runtime.txt
	@for extra in mqtt recording ground fleet; do \
		$(COMPILE) pyproject.toml --extra $$extra -c requirements/dev.txt --no-annotate -o requirements/$$extra.txt || exit 1; \
	done
	@$(COMPILE) requirements/build.in -o requirements/build.txt
	@$(COMPILE) requirements/tools.in -o requirements/tools.txt
	@git --no-pager diff --stat -- requirements

sbom: $(TOOLS)/.made
	@$(TOOLS)/bin/python packaging/sbom.py --extras "$(EXTRAS)"

# --strict: what could not be looked up is no clean bill of health, but a failure.
audit: $(TOOLS)/.made
	@for name in $(LOCKED) build tools; do \
		echo "== requirements/$$name.txt"; \
		$(TOOLS)/bin/pip-audit --strict --disable-pip --require-hashes --progress-spinner off \
			-r requirements/$$name.txt || { echo "make audit: requirements/$$name.txt is NOT known to be clean:" \
			"it has known vulnerabilities, or the service that knows of them was not reached (see above)" >&2; exit 1; }; \
	done

clean:
	rm -rf build dist $(VENV) $(TOOLS) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
