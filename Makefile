# The three things a person does here: make run, make test, make format.
# Needs Python 3.11 to 3.13 and nothing else; everything goes into .venv.

STEPS ?= 1000000

# The first interpreter that is new enough; `make run PYTHON=/path/to/python3.12` chooses one by hand.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	"$$p" -c 'import sys; raise SystemExit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null && echo "$$p" && break; \
	done)

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
SOURCES := bidex_meta algos tests

.DEFAULT_GOAL := help
.PHONY: help run test test-all test-parity lint format clean
.DELETE_ON_ERROR:

help:
	@echo "make run       train MT-PPO on MT4 for STEPS=$(STEPS) environment steps and evaluate it"
	@echo "make test      format, lint, types, tests (what CI runs)"
	@echo "make test-all  the same with the slow tests"
	@echo "make test-parity  compare both engines on every class (what CI runs too)"
	@echo "make format    format the code and mend what ruff can mend"
	@echo "make clean     remove .venv, caches and built files (never runs/)"

run: .venv/.installed
	$(BIN)/bidex-meta run --suite MT4 --algo mtppo --steps $(STEPS)

test: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup

test-all: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup -m "slow or not slow"

test-parity: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n 2 -m parity

lint: .venv/.installed-dev
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/pyright

format: .venv/.installed-dev
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

clean:
	rm -rf .venv dist build .pytest_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

# torch goes first and alone: the other packages then meet the build that fits this machine instead of choosing one.
.venv/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Expected Python 3.11, 3.12 or 3.13, found none. Install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(PIP) torch
	$(PIP) -e .
	@touch $@

.venv/.installed-dev: .venv/.installed
	$(PIP) -e ".[dev]"
	@touch $@
