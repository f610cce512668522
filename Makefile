# What there is to do; `make` alone prints it. Needs Python 3.11 or newer, make and git.
PYTHON ?= python3
VENV ?= .venv
EXPERIMENT ?= paper
bin := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test process nightly lint types bench pictures clean

help: ## print this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/all ## fly the paper's mission in real time and write its report
	$(bin)/cloudrc run $(EXPERIMENT) --mode local

test: $(VENV)/dev ## run the default tests on all cores
	$(bin)/pytest -n auto

process: $(VENV)/dev ## run the tests that start processes and take real time
	$(bin)/pytest -m 'process and not full'

nightly: $(VENV)/dev ## run every test, with the full numbers: minutes
	$(bin)/pytest -n auto -m 'not process'
	$(bin)/pytest -m process

lint: $(VENV)/dev ## check format and rules
	$(bin)/ruff format --check .
	$(bin)/ruff check .

types: $(VENV)/dev ## check types
	$(bin)/mypy

bench: $(VENV)/all ## measure the closed loop against raw physics
	$(bin)/cloudrc bench

pictures: $(VENV)/all ## draw the README's picture from a flight
	rm -rf build/pictures
	$(bin)/cloudrc run paper --mode virtual --out build/pictures
	cp build/pictures/figures/flight.png docs/flight.png

clean: ## remove the environment and what tools left
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis

# The stamps are newer than pyproject.toml while the environment is what it asks for.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "cloudrc needs Python 3.11 or newer; name one: make PYTHON=python3.12 ..." >&2; exit 3; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/all: pyproject.toml | $(VENV)/bin/python
	$(bin)/python -m pip install --quiet --editable '.[all]'
	@touch $@

$(VENV)/dev: pyproject.toml | $(VENV)/bin/python
	$(bin)/python -m pip install --quiet --editable '.[dev]'
	@touch $(VENV)/all $@
