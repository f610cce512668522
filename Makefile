# SPDX-License-Identifier: Apache-2.0

# Targets for developers; `make` alone lists them. Needs Python 3.11 or newer, make and git.
PYTHON ?= python3
VENV ?= .venv
EXPERIMENT ?= paper
bin := $(VENV)/bin
VERSION := $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' cloudrc/version.py)
# Prefix of the images' names, with a slash at the end: make images REGISTRY=ghcr.io/me/
REGISTRY ?=
# Base image, if not that of the Dockerfiles, which name theirs by digest: BASE=registry.example/python:3.11-slim-bookworm.
BASE ?=
CLUSTER ?= cloudrc
# For ROS 2 in the cluster also cloud-ros: IMAGES=cloud-ros, and ROS=kilted for another distribution.
IMAGES := world world-camera cloud
ROS :=
# The second tag of the images, by which a rebuilt image restarts pods: VERSION-gCOMMIT, and -dirty with a
# hash of the files of the images that differ from it.
IN_IMAGES := cloudrc images pyproject.toml hatch_build.py examples/ros2/cloudrc_nodes
CHANGED = $(shell { git diff --name-only HEAD -- $(IN_IMAGES); \
	git ls-files --others --exclude-standard -- $(IN_IMAGES); } 2>/dev/null)
COMMIT = $(shell git rev-parse --short HEAD 2>/dev/null)
BUILT = $(VERSION)-g$(or $(COMMIT),unknown)$(if $(CHANGED),-dirty-$(shell \
	cat $(CHANGED) 2>/dev/null | git hash-object --stdin | cut -c1-7))
SCRIPTS := .ci/run .ci/once_more images/cloud-ros/with-ros
# Number of flights at once in the search for faults.
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
# Folder for the results of `make faults`, `make mutants` and `make nightly`.
EVIDENCE := build/evidence
# A failing schedule is kept in $(EVIDENCE)/regressions: `pytest --schedule=FILE` flies it again, and in
# tests/faults/regressions it becomes a test.
SEARCH = $(bin)/python -m tests.faults --jobs $(JOBS) --store $(EVIDENCE)/regressions
NAMED = $(bin)/pytest -n $(JOBS) --dist worksteal -m fault tests/faults
# The duration of each search of `make faults` [min], and of those for further robots.
MINUTES ?= 5
ROBOT_MINUTES ?= 1
ROBOTS := x2 nano rover
# The tests of one part: make test T=tunnel, make test T=tests/doors/cli/test_run.py.
T ?=
PART = $(if $(T),$(or $(wildcard tests/$(T) tests/*/$(T)),$(T)))
# Tests of guard, tunnel and store that take seconds.
SLOW := %_any_input.py %_flight.py %_machine.py %_proof.py %_hostile.py
CORE := $(filter-out $(SLOW),$(wildcard \
	tests/world/guard/test_*.py tests/wire/tunnel/test_*.py tests/teleop/test_store.py))
BUILD_ARGS := $(BASE:%=--build-arg BASE=%) $(ROS:%=--build-arg ROS=%) --build-arg VERSION=$(VERSION) \
	--build-arg SOURCE=$(or $(filter https://%,$(shell git config remote.origin.url)),unpublished) \
	--build-arg REVISION=$(or $(shell git rev-parse HEAD 2>/dev/null),unknown)
# Independent of the processor: the lock has the hashes of all wheels for Linux.
COMPILE = $(bin)/uv pip compile --quiet --upgrade --python-version 3.11 --python-platform linux \
	--generate-hashes --no-emit-index-url --custom-compile-command 'make lock'
ROS_PACKAGES := rclpy rmw-fastrtps-cpp nav-msgs geometry-msgs sensor-msgs rosgraph-msgs std-msgs std-srvs \
	diagnostic-msgs visualization-msgs
# MuJoCo's viewers, a tenth of the image: a pod draws nothing, but with world-camera.
DRAWING := glfw pyopengl mujoco-studio

# Some environments set this variable: then each of the tests' processes compiles all modules again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo live live-flight test process process-shared process-alone e2e e2e-full test-tun smoke-tun ros2-test ros2-smoke moonshot test-netem smoke-netem test-netem-full faults faults-named faults-random faults-hostile coverage mutants nightly viser lint spdx types api audit bench bench-cell results shown pictures hashes docs site dist owner images kind-load lock clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-15s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/all ## fly the paper's mission in virtual time and write its report: seconds
	@$(bin)/cloudrc run $(EXPERIMENT) --mode virtual
	@printf '\nnext:\n  %-31s %s\n  %-31s %s\n' \
		'make live' 'the same in real time: processes and UDP on this machine' \
		'$(bin)/cloudrc up --console' 'a page in the browser: watch and steer the robot'

# The flight is a step of its own: else "Error 6" is the last line that a person sees.
live: live-flight ## fly the same mission in real time, over UDP on this machine
	@$(if $(filter 6,$(shell cat $(VENV)/live)),$(error $(TOO_SLOW)))exit $$(cat $(VENV)/live)

live-flight: $(VENV)/all
	@$(bin)/cloudrc run $(EXPERIMENT) --mode local; echo $$? > $(VENV)/live

TOO_SLOW = INVALID, this machine was too busy: close other programs and fly again, or fly in virtual \
	time with 'make demo'

test: $(VENV)/dev ## run the default tests on all cores; of one part: make test T=tunnel
	$(bin)/pytest -n auto $(PART)

# Only the files with such tests: to collect all tests takes a quarter of a minute.
PROCESS = $(shell grep -rl --include='test_*.py' 'mark\.process' tests)
process: process-shared process-alone ## run the tests that start processes and take real time

process-shared: $(VENV)/dev
	$(bin)/pytest -n 2 -m 'process and not alone and not full' $(PROCESS)

process-alone: $(VENV)/dev
	$(bin)/pytest -m 'process and alone and not full' $(PROCESS)

# With KUBECONFIG set, the tests use that cluster and make and remove only their own objects.
e2e: $(VENV)/dev ## fly on a new kind cluster, or on that of KUBECONFIG (KEEP=1 keeps it)
	$(bin)/pytest -m 'e2e and not full' tests/e2e $(if $(KEEP),--keep)

e2e-full: $(VENV)/dev ## as e2e, with all faults on the cluster and a new Secret: minutes
	$(bin)/pytest -m e2e tests/e2e $(if $(KEEP),--keep)

test-tun: $(VENV)/dev ## run the tests of two programs in namespaces; needs root or user namespaces
	$(bin)/pytest -m 'tun and not full' tests/link/exec

smoke-tun: $(VENV)/dev ## of these the few that every push runs
	$(bin)/pytest -m 'tun and smoke' tests/link/exec

ros2-test: build/ros-jazzy/done build/ros-kilted/done ## fly with nodes of ROS 2 Jazzy and Kilted, from wheels; x86-64 Linux only
	build/ros-jazzy/bin/python -m pytest -m 'ros2 and not full' tests/doors/bridges
	build/ros-kilted/bin/python -m pytest -m 'ros2 and not full' tests/doors/bridges

ros2-smoke: build/ros-jazzy/done build/ros-kilted/done ## of these one flight each, and one in real time, which every push runs
	build/ros-jazzy/bin/python -m pytest -m 'ros2 and smoke' tests/doors/bridges
	build/ros-kilted/bin/python -m pytest -m 'ros2 and smoke and not alone' tests/doors/bridges

# A real ROS 2 in an environment of its own, which also has the packages of $(VENV).
build/ros-%/done: tests/doors/bridges/ros-%.txt | $(VENV)/dev
	@test "$$(uname -sm)" = "Linux x86_64" || { echo "no wheels of ROS 2 for this machine: source a \
	ROS 2, and run pytest -m ros2 tests/doors/bridges" >&2; exit 3; }
	rm -rf build/ros-$*
	$(bin)/python -m venv build/ros-$*
	build/ros-$*/bin/python -m pip install --disable-pip-version-check --quiet --no-deps \
		--require-hashes --requirement $<
	echo "import site; site.addsitedir('$$($(bin)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')')" \
		> "$$(build/ros-$*/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/dev.pth"
	@touch $@

MOONSHOT = moonshot moonshot-disturbed
moonshot: $(VENV)/dev build/ros-jazzy/done ## 523 flights up to a round trip of a second: all succeed in the same time? 40 minutes
	rm -rf build/moonshot
	for name in $(MOONSHOT); do $(bin)/cloudrc sweep run docs/sweeps/$$name.yaml --out build/moonshot/$$name || true; done
	$(bin)/python -m tools.moonshot build/moonshot
	build/ros-jazzy/bin/python -m pytest -m ros2 -k moonshot tests/doors/bridges

# Without root or sch_netem, pytest ends with 3; make turns every failure into 2.
test-netem: $(VENV)/dev ## run the tests of netem in the kernel; needs root and sch_netem
	$(bin)/pytest -m 'netem and not full' -rP tests/link

smoke-netem: $(VENV)/dev ## of these the few that every push runs: shape, measure, verify a profile
	$(bin)/pytest -m smoke tests/link/test_netem_real.py tests/link/verify/test_netem.py

test-netem-full: $(VENV)/dev ## as test-netem, and every shipped profile for a minute
	$(bin)/pytest -m netem -rP tests/link

faults: faults-named faults-random faults-hostile ## inject every fault, then search for MINUTES (5) each: random faults, hostile clouds

faults-named: $(VENV)/dev
	$(NAMED)

faults-random: $(VENV)/dev
	$(SEARCH) --minutes $(MINUTES)

faults-hostile: $(VENV)/dev
	$(SEARCH) --minutes $(MINUTES) --hostile
	for robot in $(ROBOTS); do \
		$(SEARCH) --minutes $(ROBOT_MINUTES) --hostile --robot $$robot || exit 1; done

coverage: $(VENV)/dev ## fail unless every branch of guard, tunnel and store is tested
	$(bin)/pytest -n auto --hypothesis-seed=0 --cov --cov-report=term $(CORE)

# mutmut writes into its working folder. `mutmut show NAME` in build/mutants shows a mutant.
mutants: $(VENV)/deep ## mutate guard, tunnel and store, list the mutants that tests find
	rm -rf build/mutants && mkdir -p build/mutants $(EVIDENCE)
	cp -r cloudrc tests pyproject.toml build/mutants
	find build/mutants/tests -name 'test_*.py' -delete && rm -r build/mutants/tests/chart && cp --parents $(CORE) build/mutants
	cd build/mutants && $(abspath $(bin))/python -m mutmut run $(MUTANTS)
	cd build/mutants && $(abspath $(bin))/python -m mutmut results --all true \
		> $(CURDIR)/$(EVIDENCE)/mutants.txt

# In this order; each part runs even if an earlier one has failed. The part on a cluster needs Docker,
# kind, helm and kubectl.
NIGHT := $(addprefix $(EVIDENCE)/,tests.xml process.xml faults.xml \
	search-hostile.json $(ROBOTS:%=search-%.json) search-random.json \
	mujoco-oldest.json mujoco-newest.json delayed-cartpole.md) \
	mutants night-tun night-ros2 night-netem e2e-full

nightly: $(VENV)/deep ## run every test, search and bench; writes build/evidence (needs what e2e needs)
	rm -rf $(EVIDENCE) && mkdir -p $(EVIDENCE)
	$(MAKE) --jobs=1 --keep-going $(NIGHT)

$(EVIDENCE)/tests.xml:
	$(bin)/pytest -n auto -m 'not process and not e2e and not netem and not tun and not ros2' --fault-seed 2 --junitxml=$@

$(EVIDENCE)/process.xml:
	REQUIRE_ALL=1 $(bin)/pytest -m process --junitxml=$@

$(EVIDENCE)/faults.xml:
	$(NAMED) --junitxml=$@

$(EVIDENCE)/search-hostile.json:
	$(SEARCH) --hostile --minutes 5 --json > $@

$(ROBOTS:%=$(EVIDENCE)/search-%.json): $(EVIDENCE)/search-%.json:
	$(SEARCH) --hostile --robot $* --minutes 1 --json > $@

$(EVIDENCE)/search-random.json:
	$(SEARCH) --minutes 10 --json > $@

# The paper's mission on the oldest and on the newest MuJoCo that pyproject.toml allows.
$(EVIDENCE)/mujoco-oldest.json: MUJOCO = mujoco==$(shell sed -n 's/.*"mujoco>=\([0-9.]*\),.*/\1/p' pyproject.toml)
$(EVIDENCE)/mujoco-newest.json: MUJOCO = mujoco
$(EVIDENCE)/mujoco-%.json:
	rm -rf build/mujoco-$* && $(PYTHON) -m venv build/mujoco-$*
	build/mujoco-$*/bin/pip install --quiet '.[world,record,report]' '$(MUJOCO)'
	build/mujoco-$*/bin/cloudrc run paper --mode virtual --out build/mujoco-$*/run -o json > $@

# PPO learns through a link, in an environment of its own, because PyTorch takes 5 GB.
$(EVIDENCE)/delayed-cartpole.md:
	rm -rf build/sb3 && $(PYTHON) -m venv build/sb3
	build/sb3/bin/pip install --quiet '.[gym]' stable-baselines3
	build/sb3/bin/python examples/delayed_cartpole.py > $@

# Beside, not in the environment: a clone keeps its versions.
CONSOLE_PACKAGES = viser uvicorn websockets
CONSOLE_TESTS = tests/doors/console tests/results/report/test_replay.py tests/results/report/test_scene.py -m 'not full'
viser: $(VENV)/dev ## test console and replay on the locked viser and web servers, and on the newest ones
	locked="$$(for name in $(CONSOLE_PACKAGES); do grep -o "^$$name==[0-9.]*" tests/requirements.txt; done)"; \
	for packages in "$$locked" "$(CONSOLE_PACKAGES)"; do \
		rm -rf build/viser && $(bin)/python -m pip install --quiet --no-deps --target build/viser $$packages \
		&& ls -d build/viser/*.dist-info && PYTHONPATH=build/viser $(bin)/pytest $(CONSOLE_TESTS) || exit 1; done

.PHONY: night-tun night-ros2 night-netem
night-tun:
	$(bin)/pytest -m tun tests/link/exec

night-ros2: build/ros-jazzy/done build/ros-kilted/done
	build/ros-jazzy/bin/python -m pytest -m ros2 tests/doors/bridges
	build/ros-kilted/bin/python -m pytest -m ros2 tests/doors/bridges

night-netem:
	@if unshare --net tc qdisc add dev lo root netem delay 1ms; then $(MAKE) test-netem-full; \
		else echo "no sch_netem for this user here: 'make test-netem-full' is left out"; fi

lint: $(VENV)/dev ## check format and rules
	$(bin)/ruff format --check .
	$(bin)/ruff check .
	$(bin)/lint-imports
	$(bin)/codespell
	$(bin)/zizmor --offline --quiet --min-severity medium .github
	$(bin)/hadolint images/*/Dockerfile
	$(bin)/shellcheck $(SCRIPTS)
	@if command -v actionlint >/dev/null; then actionlint -ignore SC1090; \
		else echo "no actionlint here: the workflows are not checked"; fi
	@if command -v helm >/dev/null; then helm lint --quiet --strict --kube-version 1.29.0 charts/cloudrc; \
		else echo "no helm here: the chart is checked by 'make test' alone"; fi
	@! { $(LICENSED) | xargs -0 grep -L SPDX-License-Identifier $(SCRIPTS) | grep .; } || { \
		echo "these files lack the line of the licence; run: make spdx" >&2; exit 1; }

# Sources that name their licence, beside SCRIPTS. REUSE.toml speaks for all other files, and for those of one byte.
LICENSED = git ls-files -z -- '*.py' '*.c' '*.js' '*.css' Makefile 'images/*/Dockerfile' '.github/**.y*ml' \
	':!tests/fixtures' ':!tests/studies/exercise/solution' | xargs -0 sh -c 'find "$$@" -size +1c -print0' find
spdx: $(VENV)/dev ## write the line of the licence into new sources (with the tool of REUSE)
	$(bin)/python -m pip install --quiet 'reuse>=6'
	$(LICENSED) | xargs -0 $(bin)/reuse annotate --license Apache-2.0 --skip-existing
	$(bin)/reuse annotate --license Apache-2.0 --skip-existing --style python $(SCRIPTS)

AUDIT := $(bin)/pip-audit --require-hashes --disable-pip --progress-spinner off
audit: $(VENV)/dev ## look up the images' packages in the advisories; write an SBOM of each to build/sbom
	$(bin)/python -m pip install --quiet 'pip-audit>=2.9'
	mkdir -p build/sbom
	for role in world world-camera cloud cloud-ros; do \
		$(AUDIT) --requirement images/$$role/requirements.txt \
			--format cyclonedx-json --output build/sbom/$$role.json || exit 1; \
	done

types: $(VENV)/dev ## check types
	$(bin)/mypy

# The commit to compare with; default: the last release.
SINCE ?=
api: $(VENV)/dev ## list changes of the public Python API since the last release, or since SINCE
	$(bin)/python -m tools.api $(SINCE)

# AGAINST=COMMIT compares with that commit; FLIGHTS=20 flies more often; ROWS=fast takes a part.
AGAINST ?=
FLIGHTS ?= 12
ROWS ?=
bench: $(VENV)/dev ## measure flights of all kinds beside steps; AGAINST=COMMIT: beside that commit
	@$(bin)/python -m tools.bench --flights $(FLIGHTS) $(AGAINST:%=--against %) $(if $(ROWS),--rows '$(ROWS)')

bench-cell: $(VENV)/all ## measure how punctual the cell of 50 robots is
	$(bin)/python -m tools.bench_cell $(BENCH_CELL)

results: $(VENV)/dev ## fly the results of docs/results.md, docs/reproduce.md and docs/link.md; needs EGL: an hour
	$(bin)/python -m tools.results
	$(bin)/python -m tools.radio
	$(bin)/python -m tools.eyes

shown: $(VENV)/dev ## compare the numbers on pages with what their commands give: 15 minutes
	$(bin)/python -m tools.shown

pictures: $(VENV)/dev ## draw the README's film and the pictures of robots and missions; needs EGL (libegl1): minutes
	@$(bin)/python -c "import tools.pictures.stage" || { \
		echo "make pictures needs EGL: apt-get install libegl1 libgl1-mesa-dri libopengl0" >&2; exit 3; }
	$(bin)/python -m tools.pictures

hashes: $(VENV)/dev ## fly the commands of tests/flights/hashes.json, and write their hashes: minutes
	$(bin)/python -m tests.flights.hashes

docs: $(VENV)/dev ## write the generated tables of docs/, and the chart's schema, table and copied files
	$(bin)/python -m tools.docs

site: $(VENV)/site ## build all pages into build/site; a link that leads nowhere is an error
	$(bin)/python -m tools.site pages build/pages
	$(bin)/zensical build --strict --clean
	$(bin)/python -m tools.site plain build/pages build/site
	$(bin)/python -m tools.fly_here build/site/fly-here/index.html
	$(bin)/python -m tools.site check build/site
	$(bin)/python -m tools.words

# The time of all files in them: two builds of one commit are byte-equal.
EPOCH = $(shell git log -1 --format=%ct)
dist: $(VENV)/dev ## build wheel, sdist and chart into dist/; needs helm
	rm -rf dist
	SOURCE_DATE_EPOCH=$(EPOCH) $(bin)/python -m hatchling build -d dist -t wheel -t sdist
	$(bin)/python -m tools.pack_chart dist $(EPOCH)

# Where the account that publishes stands; `make docs` copies it from CITATION.cff. The workflow `release` asks for it.
OWNED := docs charts/cloudrc/README.md charts/cloudrc/Chart.yaml CITATION.cff .github/CODEOWNERS .github/ISSUE_TEMPLATE
owner: $(VENV)/dev ## write the account that publishes into pages, badges and links of alerts: make owner OWNER=me
	@test '$(OWNER)' || { echo "name the account: make owner OWNER=me" >&2; exit 2; }
	grep -rlw OWNER $(OWNED) | xargs sed -i 's/\bOWNER\b/$(OWNER)/g'
	sed -i 's|^  runbooks: ""|  runbooks: https://$(OWNER).github.io/cloudrc|' charts/cloudrc/values.yaml
	$(bin)/python -m tools.docs
	@echo 'The authors are in CITATION.cff: name them there, then run make docs.'

images: ## build the container images; needs Docker
	@command -v docker >/dev/null || { \
		echo "make images needs Docker: https://docs.docker.com/engine/install" >&2; exit 3; }
	for role in $(IMAGES); do \
		DOCKER_BUILDKIT=1 docker build --quiet --file images/$${role%-camera}/Dockerfile --build-arg ROLE=$$role \
			--tag $(REGISTRY)cloudrc/$$role:$(VERSION) --tag $(REGISTRY)cloudrc/$$role:$(BUILT) \
			$(BUILD_ARGS) . || exit 1; \
	done
	@mkdir -p build && echo $(BUILT) > build/image-tag

kind-load: LOADED = $(shell cat build/image-tag 2>/dev/null || echo $(VERSION))
kind-load: ## load the images into the kind cluster CLUSTER (cloudrc)
	@command -v kind >/dev/null || { \
		echo "make kind-load needs kind: https://kind.sigs.k8s.io" >&2; exit 3; }
	@kind get clusters 2>/dev/null | grep -qx $(CLUSTER) || { \
		echo "no kind cluster '$(CLUSTER)': kind create cluster --config kind-config.yaml" >&2; \
		exit 3; }
	kind load docker-image --name $(CLUSTER) \
		$(foreach tag,$(VERSION) $(LOADED),$(IMAGES:%=$(REGISTRY)cloudrc/%:$(tag)))
	@mkdir -p build/loaded && echo $(LOADED) > build/loaded/kind-$(CLUSTER)
	@echo "to restart the pods of a release with these images: helm upgrade cloudrc charts/cloudrc" \
		"--reset-then-reuse-values --set image.tag=$(LOADED)"

lock: $(VENV)/bin/python ## update the locked requirements of images and tests
	$(bin)/python -m pip install --quiet uv
	$(COMPILE) pyproject.toml --extra world --extra record --extra console --extra mpc --extra bucket \
		--output-file images/world/requirements.txt \
		$(DRAWING:%=--no-emit-package %)
	echo pyopengl | $(COMPILE) - --output-file images/world-camera/requirements.txt
	echo pillow | $(COMPILE) pyproject.toml - --extra record --extra api --extra mpc \
		--output-file images/cloud/requirements.txt
	echo pillow | $(COMPILE) pyproject.toml - --extra world --extra record --extra api --extra policy --extra mpc \
		--output-file images/cloud-ros/requirements.txt $(DRAWING:%=--no-emit-package %)
	printf 'hatchling\ntccbox\n' | $(COMPILE) - --output-file images/build-requirements.txt
	$(COMPILE) pyproject.toml --extra dev --extra deep --no-emit-package cloudrc \
		--output-file tests/requirements.txt
	for ros in jazzy kilted; do printf "ros-$$ros-%s\n" $(ROS_PACKAGES) | $(COMPILE) - \
		--no-emit-package numpy --no-emit-package pyyaml --output-file tests/doors/bridges/ros-$$ros.txt \
		|| exit 1; done

clean: ## remove the environment and generated folders
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis

# A stamp newer than pyproject.toml means that the environment is up to date.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "cloudrc needs Python 3.11 or newer; name one: make PYTHON=python3.12 ..." >&2; exit 3; }
	@echo "makes the environment $(VENV)"
	@$(PYTHON) -m venv $(VENV)

# Byte code of all packages takes 140 MB and eight seconds; Python makes that of the used modules.
INSTALL = $(bin)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable

$(VENV)/all: pyproject.toml | $(VENV)/bin/python
	@echo "installs cloudrc and its packages into it, once: half a minute, 430 MB"
	@echo "(MuJoCo, matplotlib, NumPy, the clients of Kubernetes and of the browser)"
	@$(INSTALL) '.[all]'
	@touch $@

$(VENV)/dev: pyproject.toml | $(VENV)/bin/python
	@echo "installs cloudrc, its packages and its test tools into $(VENV), once: a minute, 980 MB"
	@$(INSTALL) '.[dev]'
	@touch $(VENV)/all $@

$(VENV)/deep: pyproject.toml | $(VENV)/dev
	@echo "installs what proves, fuzzes and mutates the guard and the tunnel into $(VENV): 235 MB"
	@$(INSTALL) '.[dev,deep]'
	@touch $(VENV)/all $(VENV)/dev $@

# Not an extra: pip would install cloudrc again, while .ci/run flies with it.
$(VENV)/site: tools/site-requirements.txt | $(VENV)/dev
	$(bin)/python -m pip install --disable-pip-version-check --quiet --requirement $<
	@touch $@
