# What there is to do; `make` alone prints it. Needs Python 3.11 or newer, make and git.
PYTHON ?= python3
VENV ?= .venv
EXPERIMENT ?= paper
bin := $(VENV)/bin
VERSION := $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' cloudrc/__init__.py)
# Put before the images' names, with a slash at its end: make images REGISTRY=ghcr.io/me/
REGISTRY ?=
# What the images stand on, if not their Dockerfiles' tag: BASE=python:3.11-slim-bookworm@sha256:...
BASE :=
CLUSTER ?= cloudrc
IMAGES := world cloud
SCRIPTS := .ci/run
# Flights at once in the search for faults.
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
# What the search finds is shrunk and becomes a test, until it is mended a failing one.
STORE := --store tests/faults/regressions
# What tests guard, tunnel and journal in seconds.
SLOW := %_any_input.py %_falls.py %_flight.py %_machine.py %_proof.py %_hostile.py
CORE := $(filter-out $(SLOW),$(wildcard \
	tests/world/test_guard*.py tests/tunnel/test_*.py tests/cloud/test_teleop_journal*.py))
BUILD_ARGS := $(BASE:%=--build-arg BASE=%) --build-arg VERSION=$(VERSION) \
	--build-arg SOURCE=$(or $(filter https://%,$(shell git config remote.origin.url)),unpublished) \
	--build-arg REVISION=$(or $(shell git rev-parse HEAD 2>/dev/null),unknown)
# Universal in the processor: the hashes of all wheels for Linux are in the lock.
COMPILE = $(bin)/uv pip compile --quiet --upgrade --python-version 3.11 --python-platform linux \
	--generate-hashes --no-emit-index-url --custom-compile-command 'make lock'
# MuJoCo's viewers: a pod draws nothing, and they are a tenth of the image.
DRAWING := glfw pyopengl mujoco-studio websockets

.DEFAULT_GOAL := help
.PHONY: help demo test process e2e e2e-full test-netem test-netem-full faults figures coverage mutants nightly lint types bench bench-link pictures docs images kind-load lock chart-docs clean

help: ## print this list
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-15s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/all ## fly the paper's mission in real time and write its report
	$(bin)/cloudrc run $(EXPERIMENT) --mode local

test: $(VENV)/dev ## run the default tests on all cores
	$(bin)/pytest -n auto

process: $(VENV)/dev ## run the tests that start processes and take real time
	$(bin)/pytest -m 'process and not full'

# With KUBECONFIG set, the release goes into that cluster, and nothing is made or removed but ours.
e2e: $(VENV)/dev ## fly on a kind cluster of its own, or that of KUBECONFIG (KEEP=1 leaves it)
	$(bin)/pytest -m 'e2e and not full' tests/e2e $(if $(KEEP),--keep)

e2e-full: $(VENV)/dev ## the same with every fault of the cluster's suite, its Secret rotated: minutes
	$(bin)/pytest -m e2e tests/e2e $(if $(KEEP),--keep)

# Without root or sch_netem pytest exits with 3; make turns every failure into its own 2.
test-netem: $(VENV)/dev ## run the tests of the kernel's netem; needs root and sch_netem
	$(bin)/pytest -m 'netem and not full' -rP tests/link

test-netem-full: $(VENV)/dev ## the same, and every shipped profile for a minute
	$(bin)/pytest -m netem -rP tests/link

# What the search shows in short goes below build/: the pages in docs/ are of make nightly's seeds.
faults: $(VENV)/dev ## bring every fault about, compose 200 at random; writes docs/safety/faults.md
	$(bin)/cloudrc faults run --all --jobs $(JOBS) --document docs/safety/faults.md
	mkdir -p build
	$(bin)/cloudrc faults fuzz --seeds 200 --jobs $(JOBS) --document build/search.md $(STORE)
	$(bin)/cloudrc faults fuzz --adversarial --seeds 200 --jobs $(JOBS) \
		--document build/adversary.md $(STORE)

figures: $(VENV)/dev ## print the numbers that tests have measured: asked, measured, of how many
	$(bin)/python tools/figures.py

coverage: $(VENV)/dev ## fail unless every branch of guard, tunnel and journal is tested
	$(bin)/python -m coverage run -m pytest --hypothesis-seed=0 $(CORE)
	$(bin)/python -m coverage report

# mutmut writes where it runs; docs/safety/mutants.md says why each of those that survive may.
mutants: $(VENV)/dev ## change guard, tunnel and journal in small ways; 1 if the page lists other ones
	rm -rf build/mutants && mkdir -p build/mutants
	cp -r cloudrc tests tools pyproject.toml build/mutants
	find build/mutants/tests -name 'test_*.py' -delete && cp --parents $(CORE) build/mutants
	cd build/mutants && $(abspath $(bin))/python -m mutmut run $(MUTANTS)
	cd build/mutants && $(abspath $(bin))/python -m mutmut results --all true > results.txt
	$(bin)/python tools/mutants.py < build/mutants/results.txt

# The long numbers, and the tests that reach them; the seeds and the real floods are lines below.
#   10^7 hostile datagrams, coverage-guided    test_coverage_guided_ones
#   10^6 hostile datagrams, by chance          test_a_million_hostile_datagrams
#   every bit of 1,000 datagrams flipped       test_no_bit_of_a_thousand_datagrams_can_be_flipped
#   every sequence of 6 of 16 counters         test_every_sequence_of_six_agrees_with_a_set
#   two clouds, interleaved to depth 10        test_no_interleaving_of_ten_takes_a_command_back
#   10^6 cases of hypothesis at the guard      test_a_million_cases_of_hypothesis_stay_inside_the_caps
#   10^6 commands and readings of the guard    test_a_million_commands_and_readings_stay_inside_the_caps
#   silent from 200 instants on, 1.5 m/s       test_without_its_cloud_the_robot_stops_at_any_instant
#   silent from 200 instants on, uncapped      test_uncapped_it_takes_a_little_longer_at_any_instant
#   killed at 200 instants, a new process      test_killed_at_any_instant_a_new_cloud_flies_on
#   blackouts at 24 instants, each way         test_a_silence_anywhere_touches_nothing
#   1,000 requests a second for 20 s           test_a_thousand_requests_a_second_do_not_disturb_the_control_loop
# The search takes hours: told to stop (Ctrl-C, SIGTERM) it keeps what was flown as a slice, and
# says how to go on. Slices of one search, flown by the same sources, make the page as well:
#   cloudrc faults fuzz --first 1 --seeds 15000 --slice build/a.json
#   cloudrc faults fuzz --first 15001 --seeds 15000 --slice build/b.json
#   cloudrc faults merge build/a.json build/b.json --document docs/safety/search.md
# The cluster comes last: without Docker, kind, helm and kubectl all else is done.
nightly: $(VENV)/dev ## run every test and number, 500 hours of faults, e2e-full (needs what e2e needs)
	rm -rf build/figures
	$(bin)/pytest -n auto -m 'not process and not e2e and not netem'
	$(bin)/pytest -m process
	$(bin)/cloudrc faults run --all --real --document docs/safety/faults-real.md
	CLOUDRC_FLOOD_SECONDS=600 $(bin)/cloudrc faults run garbage-flood --real
	$(bin)/cloudrc faults fuzz --clean --seeds 600 --jobs $(JOBS) \
		--document docs/safety/clean.md $(STORE)
	$(bin)/cloudrc faults fuzz --adversarial --seeds 5000 --jobs $(JOBS) \
		--document docs/safety/adversary.md $(STORE)
	$(bin)/cloudrc faults fuzz --seeds 30000 --jobs $(JOBS) \
		--document docs/safety/search.md $(STORE)
	$(MAKE) mutants
	$(bin)/python -m tools.bench_link $(BENCH_LINK)
	@if unshare --net tc qdisc add dev lo root netem delay 1ms; then $(MAKE) test-netem-full; \
		else echo "no sch_netem for this user here: 'make test-netem-full' is left out"; fi
	$(bin)/python tools/figures.py --document docs/safety/numbers.md
	$(MAKE) e2e-full

lint: $(VENV)/dev ## check format and rules
	$(bin)/ruff format --check .
	$(bin)/ruff check .
	$(bin)/hadolint images/*/Dockerfile
	$(bin)/shellcheck $(SCRIPTS)
	@if command -v helm >/dev/null; then helm lint --quiet --strict charts/cloudrc; \
		else echo "no helm here: the chart is checked by 'make test' alone"; fi

types: $(VENV)/dev ## check types
	$(bin)/mypy

bench: $(VENV)/all ## measure the closed loop against raw physics
	$(bin)/cloudrc bench

# Without a C compiler it exits with 3; make turns every failure into its own 2.
bench-link: $(VENV)/all ## measure the relay against what was asked, and C anchors; needs cc
	$(bin)/python -m tools.bench_link $(BENCH_LINK)

pictures: $(VENV)/all ## draw the README's picture from a flight
	rm -rf build/pictures
	$(bin)/cloudrc run paper --mode virtual --out build/pictures
	cp build/pictures/figures/flight.png docs/flight.png

docs: $(VENV)/all ## write docs/metrics.md from the table of metrics
	$(bin)/python -m cloudrc.exposition.document > docs/metrics.md

images: ## build the containers' images; needs Docker
	@command -v docker >/dev/null || { \
		echo "make images needs Docker: https://docs.docker.com/engine/install" >&2; exit 3; }
	for role in $(IMAGES); do \
		DOCKER_BUILDKIT=1 docker build --quiet --file images/$$role/Dockerfile \
			--tag $(REGISTRY)cloudrc/$$role:$(VERSION) $(BUILD_ARGS) . || exit 1; \
	done

kind-load: ## load the images into the kind cluster CLUSTER (cloudrc)
	@command -v kind >/dev/null || { \
		echo "make kind-load needs kind: https://kind.sigs.k8s.io" >&2; exit 3; }
	@kind get clusters 2>/dev/null | grep -qx $(CLUSTER) || { \
		echo "no kind cluster '$(CLUSTER)': kind create cluster --config kind-config.yaml" >&2; \
		exit 3; }
	kind load docker-image --name $(CLUSTER) $(IMAGES:%=$(REGISTRY)cloudrc/%:$(VERSION))

lock: $(VENV)/bin/python ## write the requirements of images and tests again
	$(bin)/python -m pip install --quiet uv
	$(COMPILE) pyproject.toml --extra world --extra record --output-file images/world/requirements.txt \
		$(DRAWING:%=--no-emit-package %)
	$(COMPILE) pyproject.toml --extra record --extra api --output-file images/cloud/requirements.txt
	echo hatchling | $(COMPILE) - --output-file images/build-requirements.txt
	$(COMPILE) pyproject.toml --extra dev --no-emit-package cloudrc \
		--output-file tests/requirements.txt

chart-docs: $(VENV)/dev ## write the chart's values, schema and tables from the models
	$(bin)/python tools/chart_docs.py

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
