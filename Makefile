# Most people need three targets: make run, make test and make format.
# They need only Python 3.11 to 3.13; everything is installed into .venv.

# make run trains on a class of version 2 that PPO learns within minutes. The discount covers a whole episode of 250
# steps, and low noise lets the policy hold still. Four door classes together had 2 % success after the same steps.
MINUTES ?= 4.6
RUN_FLAGS ?= --task DoorOpenOutward-v2 --algo ppo --num-envs 256 --learner.gamma 0.99 --learner.init-std 0.3

# This is the first interpreter that is new enough; `make run PYTHON=/path/to/python3.12` names another one.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	"$$p" -c 'import sys; raise SystemExit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null && echo "$$p" && break; \
	done)

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --no-input -c constraints.txt
SOURCES := bidex_meta algos tools examples tests docs/site

.DEFAULT_GOAL := help
.PHONY: help run quick results collect experts gallery witness test test-all test-parity goldens bench gpu-quarter lint style types tests format docs dist clean
.DELETE_ON_ERROR:

help:
	@echo "make run       train PPO on a door of version 2 for MINUTES=$(MINUTES) and compare it with a random policy"
	@echo "make test      check format, lint and types, and run the tests (CI runs this)"
	@echo "make quick     run the unit tests in less than a minute"
	@echo "make test-all  run make test with the slow tests"
	@echo "make test-parity  compare both engines on every class (CI runs this too)"
	@echo "make results   fill the tables and pictures of README.md, docs/pretrained.md and docs/results/ from results/"
	@echo "make collect   store runs as data in results/data/ (ARGS=--help lists the flags)"
	@echo "make experts   choose the best known policy of each class (ARGS=--help lists the flags)"
	@echo "make gallery   write docs/tasks.md and its pictures"
	@echo "make goldens   record the golden trajectories again after a change of results (docs/reliability.md)"
	@echo "make docs      build the documentation site into site/ (open site/index.html)"
	@echo "make witness ARGS=\"plan --task CLASS\"  search for actions that solve a task (plan, steady, whole or script; ARGS=-h)"
	@echo "make dist      build wheel and sdist into dist/, check them, and test the wheel on its own (docs/releasing.md)"
	@echo "make format    format the code and fix what ruff can fix"
	@echo "make bench ARGS=\"stability --task HandOver\"  measure speed or stability (ARGS=--help lists the measurements)"
	@echo "make gpu-quarter  test, measure and train on a GPU for 13 minutes (docs/gpu.md)"
	@echo "make clean     remove .venv, caches and built files, but not runs/"

run: .venv/.installed
	$(BIN)/bidex-meta run $(RUN_FLAGS) --minutes $(MINUTES) --episodes 1

# pyright needs one core for a minute, so it runs at the same time as the tests.
test: style
	@$(MAKE) --no-print-directory -j 2 types tests

# Hundreds of tests start a process, which starts faster from compiled modules, so writing them must be allowed.
quick tests test-all test-parity: export PYTHONDONTWRITEBYTECODE :=

# These tests need no physics and end within a minute on two free cores.
QUICK := tests/utils tests/runs tests/test_suite.py tests/test_imports.py tests/evaluation/test_scores.py tests/evaluation/test_statistics.py

quick: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup $(QUICK)

tests: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup

test-all: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup -m "slow or not slow"

test-parity: .venv/.installed-dev
	$(BIN)/python -m pytest -q -n 2 -m parity

goldens: .venv/.installed-dev
	$(BIN)/python -m tests.goldens write

# `gpu-quarter` needs a GPU; an interrupted call continues when it is called again. On a machine that has the packages
# already, name its interpreter: make gpu-quarter CLI="python3 -m bidex_meta.cli". For a dry run, add DEVICE=cpu
# SUITE=MT1-v2 SIZES="4 8" ROWS=32 TRAIN_SECONDS=1 ARGS="--rest 1".
DEVICE ?= cuda:0
OUT ?= gpu-results
SUITE ?= MT20-v2
SIZES ?= 512 8192 32768
ROWS ?= 8192
TRAIN_SECONDS ?= 60
QUARTER ?= 13
CLI ?= $(BIN)/python -m bidex_meta.cli
BENCH := $(CLI:bidex_meta.cli=tools.bench)
INSTALLED := $(if $(filter $(BIN)/%,$(CLI)),.venv/.installed)

bench gpu-quarter: export PYTHONPATH := .:algos:$(PYTHONPATH)

bench: $(INSTALLED)
	$(BENCH) $(ARGS)

gpu-quarter: $(INSTALLED:%=%-dev)
	$(BENCH) quarter --device $(DEVICE) --out $(OUT) --suite $(SUITE) --sizes $(SIZES) --num-envs $(ROWS) \
		--seconds $(TRAIN_SECONDS) --minutes $(QUARTER) $(ARGS)

results: .venv/.installed-dev
	$(BIN)/python -m tools.pages

collect experts gallery: .venv/.installed-dev
	$(BIN)/python -m tools.$@ $(ARGS)

witness: .venv/.installed
	$(BIN)/python -m tools.witness_search $(ARGS)

lint: style types

style: .venv/.installed-dev
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/python -m tools.english

types: .venv/.installed-dev
	$(BIN)/pyright

format: .venv/.installed-dev
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

# The site needs neither torch nor this package, so it has a separate environment.
docs: .venv-docs/.installed
	.venv-docs/bin/python docs/site/build.py

.venv-docs/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Expected Python 3.11, 3.12 or 3.13, found none. Install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	test -x .venv-docs/bin/python || $(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' > .venv-docs/needed.txt
	.venv-docs/bin/python -m pip install --disable-pip-version-check -c constraints.txt -r .venv-docs/needed.txt
	@touch $@

# The wheel is built from the sdist, as a package index would do. It is then installed on its own and used outside the
# checkout.
dist: .venv-dist/.installed
	rm -rf dist
	.venv-dist/bin/python -m build --no-isolation --outdir dist
	.venv-dist/bin/python -m twine check --strict dist/*
	rm -rf .venv-dist/tried && $(PYTHON) -m venv .venv-dist/tried && mkdir .venv-dist/tried/outside
	.venv-dist/tried/bin/python -m pip install --disable-pip-version-check -c constraints.txt torch
	.venv-dist/tried/bin/python -m pip install --disable-pip-version-check -c constraints.txt dist/*.whl
	cd .venv-dist/tried/outside && env -u PYTHONPATH ../bin/bidex-meta list suites
	cd .venv-dist/tried/outside && env -u PYTHONPATH ../bin/bidex-meta demo --out demo.webp
	cd .venv-dist/tried/outside && env -u PYTHONPATH ../bin/bidex-meta run --suite MT4 --device cpu --num-envs 8 --steps 400 \
		--learner.hidden 16 --learner.rollout-steps 8 --episodes 1 --run-dir run

.venv-dist/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Expected Python 3.11, 3.12 or 3.13, found none. Install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	test -x .venv-dist/bin/python || $(PYTHON) -m venv .venv-dist
	.venv-dist/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["dist"], sep="\n")' > .venv-dist/needed.txt
	.venv-dist/bin/python -m pip install --disable-pip-version-check -c constraints.txt -r .venv-dist/needed.txt
	@touch $@

clean:
	rm -rf .venv .venv-docs .venv-dist dist build site .pytest_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

# torch is installed first, so that the other packages accept the build for this machine and do not choose another.
.venv/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Expected Python 3.11, 3.12 or 3.13, found none. Install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@echo "Installing PyTorch and the other packages, 2 GB, into .venv: two minutes or more. pip prints each package."
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(PIP) torch
	$(PIP) -e .
	@touch $@

.venv/.installed-dev: .venv/.installed
	$(PIP) -e ".[dev]"
	@touch $@
