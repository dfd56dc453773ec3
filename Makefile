# The only entrance: people, hooks and CI use the same targets. `make help` lists them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BIN_ABS := $(CURDIR)/$(BIN)
CACHE := $(CURDIR)/.cache
# Keep the compiled planner in the checkout, so that the second start is fast.
export NUMBA_CACHE_DIR ?= $(CACHE)/numba

BENCH_READY := $(VENV)/.bench-ready
DEV_READY := $(VENV)/.dev-ready
PEERS_READY := $(VENV)/.peers-ready
# Some libraries of the applications need older packages than `make install`, so they have an environment of their own.
EXAMPLES_BIN := .cache/examples/bin
EXAMPLES_READY := .cache/examples/.ready
# Ray is large, and only its own tests need it.
RAY_BIN := .cache/ray/bin
RAY_READY := .cache/ray/.ready
# The site of the documentation needs nothing of the other environments.
DOCS_BIN := .cache/docs/bin
DOCS_READY := .cache/docs/.ready

ROS2_READY := .cache/ros2-kilted/.ready .cache/ros2-jazzy/.ready

.PHONY: help demo install format lint type test test-all unit pythons integration compose chaos state bench figures docs examples ray ros2 browser prometheus torch up down table lock wheel clean

help: ## list the targets
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

demo: $(BENCH_READY) ## plan on a real map through an outage, with three processes on loopback; writes out/demo/
	$(BIN)/loadgen demo --out out/demo

install: $(DEV_READY) ## install everything that is needed to work on the code

format: $(DEV_READY) ## format the code with ruff
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lint: $(DEV_READY) ## check style and format with ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(DEV_READY) ## check types with mypy, strict
	$(BIN)/mypy --cache-dir $(CACHE)/mypy -p offboard

# tests/conftest.py says which tests are `long`, and which are `alone`.
test: $(DEV_READY) ## run what guards the core, in minutes: unit tests, and a real server, relay and robot
	$(BIN)/python -m tests.twice --numprocesses 2 -m "not long and not alone" tests/unit tests/integration
	@echo "left out: tests that take long, measure times, or need containers, a browser, Ray or ROS 2: make test-all"

test-all: test ## run every other test that this machine can run, too; skipped tests say why
	$(BIN)/python -m tests.twice --numprocesses 3 -m "long and not alone" --ignore tests/ros2
	$(BIN)/python -m tests.twice -m alone --ignore tests/ros2
	$(MAKE) --jobs 2 --output-sync=target ray ros2  # they mostly wait

unit: $(DEV_READY) ## run the tests without sockets
	$(BIN)/pytest --numprocesses 2 tests/unit

VERSIONS := 3.10 3.11 3.12 3.13
pythons: ## run the unit tests on each supported Python, VERSIONS=3.13: on this one only
	set -e; for version in $(VERSIONS); do $(MAKE) unit PYTHON=python$$version VENV=.cache/python$$version; done

integration: $(DEV_READY) ## run the tests with real sockets and processes
	$(BIN)/pytest tests/integration

compose: $(DEV_READY) ## run the tests with real containers; needs a Docker engine
	$(BIN)/pytest tests/compose

chaos: $(DEV_READY) ## run each fault 20 times (3 times in containers), each scenario, and half an hour of faults
	CHAOS=1 $(BIN)/pytest tests/chaos
	$(BIN)/loadgen run soak --out out/soak

state: $(DEV_READY) ## abuse a robot for ten minutes and count lost, wrong and hung calls, SEED=N: the same steps again
	CHAOS=1 $(BIN)/pytest -s tests/state $(if $(SEED),--hypothesis-seed=$(SEED))

bench: $(PEERS_READY) ## measure speed next to other libraries; needs an otherwise idle machine
	$(BIN)/python -m benchmarks

figures: $(DEV_READY) ## measure all figures of the docs that are not up to date, ONLY=NAME,..: these only; takes hours
	$(BIN)/python -m benchmarks.figures $(if $(ONLY),--only $(ONLY))

# Not with --quiet: it would hide the warnings from --strict, too.
docs: $(DOCS_READY) ## build the documentation as a site in out/site, strictly: a broken link or anchor fails
	$(DOCS_BIN)/python -m docs.site.reference
	NO_MKDOCS_2_WARNING=1 $(DOCS_BIN)/mkdocs build --strict
	@echo "built: out/site/index.html; with search: $(PYTHON) -m http.server --directory out/site"

examples: $(EXAMPLES_READY) ## measure the five applications with one seed, FULL=1: with three; needs an otherwise idle machine
	$(EXAMPLES_BIN)/python -m benchmarks.applications $(if $(FULL),--seeds 3)

ray: $(RAY_READY) ## test `--executor ray` on real Ray clusters of two nodes
	$(RAY_BIN)/python -m pytest -s tests/ray

ros2: $(DEV_READY) $(ROS2_READY) ## test with real rclpy of two releases of ROS; needs python3.11, python3.12 and a C++ compiler
	tests/ros2/alone.sh $(BIN)/pytest -s tests/ros2/test_goals.py
	tests/ros2/alone.sh $(BIN)/pytest --numprocesses 2 --dist worksteal --ignore tests/ros2/test_goals.py tests/ros2

browser: $(DEV_READY) ## run the tests in a real browser; needs Chromium
	$(BIN)/pytest tests/browser

# Unpacked and not installed: that needs no root, and starts no service.
PROMETHEUS := $(CACHE)/prometheus
prometheus: ## unpack Debian's Prometheus into .cache for the tests of deploy/prometheus, if apt has it
	@if command -v prometheus >/dev/null || test -x $(PROMETHEUS)/usr/bin/prometheus; then :; \
	elif mkdir -p $(PROMETHEUS) && cd $(PROMETHEUS) && apt-get download -qq -o APT::Sandbox::User=root prometheus; then \
	  dpkg-deb -x prometheus_*.deb . && rm prometheus_*.deb; \
	else echo "apt has no package prometheus: the tests of deploy/prometheus will be skipped"; fi

# On x86-64 the default PyTorch wheel brings gigabytes of CUDA, so it is installed only if pip finds a CPU build.
TORCH := torch==2.13.0
torch: $(DEV_READY) ## install PyTorch for the LSTM, if pip finds a CPU-only build
	@if test "$$(uname -m)" != x86_64 || $(BIN)/python -m pip install --quiet --dry-run --no-deps \
	  --ignore-installed --report - $(TORCH) 2>/dev/null | grep -q '"url".*cpu'; then \
	  $(BIN)/python -m pip install --quiet $(TORCH); \
	else echo "no CPU-only build of $(TORCH) found: the tests of the LSTM will be skipped"; fi

up: ## start the three containers and print the robot's table; the server stays up
	docker compose up --build

down: ## remove the containers and their volumes
	docker compose --profile observe down --volumes

table: $(BENCH_READY) ## print Table II of the dataset `paper`, next to that of the paper
	$(BIN)/loadgen table loadgen/datasets/paper.csv --published

wheel: $(DEV_READY) ## build dist/*.whl
	$(BIN)/python -m build --wheel

lock: ## pin every dependency with hashes; needs uv
	$(PYTHON) requirements/lock.py

clean: ## remove everything that the targets made, except out/
	rm -rf $(VENV) $(CACHE) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BENCH_READY): requirements/bench.txt pyproject.toml
	@echo "installing into $(VENV), once; this takes about a minute"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/bench.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

$(DEV_READY): requirements/dev.txt pyproject.toml
	@echo "installing into $(VENV), once; this takes a few minutes"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@ $(BENCH_READY)

$(PEERS_READY): requirements/peers.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/peers.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@ $(DEV_READY) $(BENCH_READY)

$(EXAMPLES_READY): requirements/examples.txt pyproject.toml
	test -x $(EXAMPLES_BIN)/python || $(PYTHON) -m venv .cache/examples
	$(EXAMPLES_BIN)/python -m pip install --quiet --require-hashes -r requirements/examples.txt
	$(EXAMPLES_BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

$(DOCS_READY): requirements/docs.txt
	test -x $(DOCS_BIN)/python || $(PYTHON) -m venv .cache/docs
	$(DOCS_BIN)/python -m pip install --quiet --require-hashes -r requirements/docs.txt
	touch $@

$(RAY_READY): requirements/ray.txt pyproject.toml
	test -x $(RAY_BIN)/python || $(PYTHON) -m venv .cache/ray
	$(RAY_BIN)/python -m pip install --quiet --require-hashes -r requirements/ray.txt
	$(RAY_BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

# Nothing else may live in these environments: the wheels of ROS restart Python, and bring an old OpenSSL.
.cache/ros2-%/.ready: requirements/ros2-%.txt tests/ros2/build.py $(wildcard tests/ros2/interfaces/*/*/*)
	$(PYTHON) tests/ros2/build.py $* .cache/ros2-$*
	test ! -d .cache/ros2-$* || touch $@
