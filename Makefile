# Each target installs its requirements into .venv if it is missing or a lock file has changed.
# demo needs only the dependencies of errormotion; the other targets need the development packages.
.DEFAULT_GOAL := help
.PHONY: help setup demo compiled test test-all lint docs wheel bench validate closed-loop fuzz guided wire faults power mutations endurance following programs pictures lowest lock

BIN := .venv/bin
ARGS ?=
# Compiled modules are stored, because many tests start processes, each of which would compile them again.
unexport PYTHONDONTWRITEBYTECODE

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):[^#]*## /  \1\t/' | expand -t 14

setup: .venv/.dev  ## install all requirements into .venv (with uv if it is installed, else pip)

demo: .venv/.core  ## measure a virtual machine: beam detection, spindle drift, report
	@$(BIN)/errormotion demo $(ARGS)

test: .venv/.compiled  ## run the tests except slow ones (ARGS="-n 0 tests/kinematics -k fit" selects tests, without workers)
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not slow" $(ARGS)

test-all: compiled  ## run all tests
	$(BIN)/python -m pytest -n auto --dist loadfile $(ARGS)

lint: .venv/.dev  ## check style, types and import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: .venv/.dev  ## build docs/_build/html; warnings are errors
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

wheel: .venv/.dev  ## build dist/*, and check the wheel in an empty environment
	$(BIN)/python tools/check_wheel

bench: .venv/.dev  ## run every benchmark and print its figures
	@set -e; for script in $(filter-out benchmarks/validate.py,$(wildcard benchmarks/*.py)); do \
		echo "== $$script"; $(BIN)/python $$script; done

validate: .venv/.dev  ## run the Monte Carlo validation and write docs/validation.md
	$(BIN)/python benchmarks/validate.py $(ARGS)

closed-loop: .venv/.dev  ## compensate 10 virtual machines in a closed loop, and write docs/validation.md
	$(BIN)/python benchmarks/validate.py closed_loop $(ARGS)

fuzz: .venv/.dev  ## try 1e6 damaged frames of every codec (ARGS="--frames 1e5") and write docs/reliability.md
	$(BIN)/python tools/fuzz.py $(ARGS)

guided: .venv/.dev  ## search for inputs that execute new code of codecs and file readers (needs pip install atheris), docs/reliability.md
	$(BIN)/python tools/guided.py $(ARGS)

wire: .venv/.dev  ## try all drivers with disturbed connections, and write docs/reliability.md
	$(BIN)/python tools/wire.py $(ARGS)

faults: .venv/.dev  ## kill runs, let disks fail, set clocks, and resume the runs, 10 minutes, and write docs/reliability.md
	$(BIN)/python tools/faults.py $(ARGS)

power: .venv/.dev  ## simulate 1000 power cuts while files of all kinds are written, 2 minutes, and write docs/reliability.md
	$(BIN)/python tools/power_cuts.py $(ARGS)

endurance: .venv/.dev  ## monitor a machine for 24 simulated hours with a fault every minute, and write docs/reliability.md
	$(BIN)/python tools/endurance.py $(ARGS)

following: .venv/.dev  ## compensate the real LinuxCNC with a fault every 30 s, 72 minutes, and write docs/reliability.md
	$(BIN)/python tools/following.py $(ARGS)

programs: .venv/.dev  ## read 1e6 random NC programs by LinuxCNC's interpreter (ARGS="--programs 2e4"), and write docs/reliability.md
	$(BIN)/python tools/programs.py $(ARGS)

pictures: compiled  ## update docs/figures/dashboard_*.png by the browser tests of the dashboard (needs chromium)
	$(BIN)/python -m pytest -n 0 tests/dashboard/test_pictures.py --pictures docs/figures

lowest: .venv/.dev  ## run tests with the lowest versions of packages that pyproject.toml allows, in .venv-lowest
	$(BIN)/python tools/lowest.py $(ARGS)
mutations: .venv/.dev  ## read 2000 altered files by commands, about 15 minutes, and write docs/reliability.md
	$(BIN)/python tools/mutations.py $(ARGS)

lock:  ## resolve the requirements in pyproject.toml into the two lock files (needs uv)
	uv pip compile -q --universal --python-version 3.11 pyproject.toml --all-extras --group build --group dev \
		--upgrade --generate-hashes --no-emit-index-url --no-header -o requirements.lock
	uv pip compile -q --universal --python-version 3.11 pyproject.toml --group build -c requirements.lock \
		--generate-hashes --no-emit-index-url --no-header --no-annotate -o requirements-core.lock

.venv/.core: requirements-core.lock pyproject.toml
	@tools/setup core

.venv/.dev: requirements.lock requirements-core.lock pyproject.toml
	@tools/setup dev

# Functions that are compiled at first use are compiled once, before the workers of the tests start.
compiled: .venv/.compiled

COMPILED := $(shell grep -rlsE 'njit|@compiled' --include='*.py' errormotion)

.venv/.compiled: .venv/.dev $(COMPILED)
	$(BIN)/python tools/precompile
	@touch $@
