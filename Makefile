# Everything runs in .venv, which the first target that needs it makes from an empty clone.
#   make demo    install, run the main job on a sample stage, say where the images are
#   make test    install with the test extras, then ruff, mypy, import-linter and pytest
#   make clean   remove .venv and what the tools leave behind

SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
# Override with `make PYTHON=/path/to/python3.12 test`.
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3; do \
	$$name -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null \
	&& command -v $$name && break; done)
# In several processes; the tests of a file share what they compute, so they stay together, and tests/conftest.py says
# which come first.
PYTEST_ARGS ?= -q -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-oldest-usd lint clean
.DEFAULT_GOAL := test

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "icheat: error: no Python 3.11, 3.12 or 3.13 on PATH; install one with its venv module, or name it: make PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "icheat: error: $(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 2; }

# A stamp is newer than pyproject.toml when what it asks for is installed.
$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable '.[dev]'
	@touch $@ $(VENV)/.installed

demo: $(VENV)/.installed
	$(BIN)/icheat demo

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/mypy icheat_usd
	$(BIN)/lint-imports

# glibc fills memory that is fresh or freed with this byte: a kernel that reads it fails a test instead of being lucky.
test: lint
	$(BIN)/icheat warm
	MALLOC_PERTURB_=85 $(BIN)/python -m pytest $(PYTEST_ARGS)
	@$(MAKE) --no-print-directory test-oldest-usd

# DCCs lag behind: what reads and writes stages is also tested on the oldest USD that pyproject.toml allows.
OLDEST_USD = $(shell $(BIN)/python -c 'import sys; print("25.5" if sys.version_info < (3, 13) else "25.8")')

$(VENV)/.oldest-usd: pyproject.toml | $(VENV)/.installed-dev
	rm -rf $(VENV)/oldest-usd
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --target $(VENV)/oldest-usd \
		usd-core==$(OLDEST_USD)
	@touch $@

test-oldest-usd: $(VENV)/.oldest-usd
	PYTHONPATH=$(CURDIR)/$(VENV)/oldest-usd $(BIN)/python -m pytest $(PYTEST_ARGS) tests/stage \
		tests/composition tests/session/test_keys.py tests/cli/test_program.py

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis demo_output
