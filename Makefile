# The only door: people, hooks and CI call the same targets. `make help` lists them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BIN_ABS := $(CURDIR)/$(BIN)
CACHE := $(CURDIR)/.cache
# Compiled planner: kept beside the checkout, so that the second start is quick.
export NUMBA_CACHE_DIR ?= $(CACHE)/numba

BENCH_READY := $(VENV)/.bench-ready
DEV_READY := $(VENV)/.dev-ready
PEERS_READY := $(VENV)/.peers-ready

.PHONY: help demo install format lint type test unit integration compose chaos bench browser torch up down table lock wheel clean

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

demo: $(BENCH_READY) ## 350 plans on a real map, three processes on loopback; writes out/demo/
	$(BIN)/loadgen demo --out out/demo

install: $(DEV_READY) ## everything for working on the code

format: $(DEV_READY) ## rewrite the code in the house's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lint: $(DEV_READY) ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy does not know that a checkout's packages lie next to `offboard/`: it reads the wheel.
type: $(DEV_READY) ## mypy, strict, on the unpacked wheel
	rm -rf $(CACHE)/typed
	$(BIN)/python -m build --wheel --no-isolation --outdir $(CACHE)/typed . >/dev/null
	cd $(CACHE)/typed && $(BIN_ABS)/python -m zipfile -e offboard-*.whl . && $(BIN_ABS)/mypy --config-file $(CURDIR)/pyproject.toml --cache-dir $(CACHE)/mypy -p offboard

# Tests that do not mind another one beside them.
CROWDED := tests/unit tests/integration/executors $(addprefix tests/integration/test_,$(addsuffix .py,alone attacks blobs channel compare cpu_time crashes dataset demo fuzz keys own_task processes robot_workload toxiproxy wheel))
test: $(DEV_READY) ## every test that this machine can run; what is skipped says why
	$(BIN)/pytest --numprocesses 2 $(CROWDED)
	$(BIN)/pytest $(addprefix --ignore ,$(CROWDED))

unit: $(DEV_READY) ## tests without sockets
	$(BIN)/pytest --numprocesses 2 tests/unit

integration: $(DEV_READY) ## tests with real sockets and processes
	$(BIN)/pytest tests/integration

compose: $(DEV_READY) ## tests with real containers; needs a Docker engine
	$(BIN)/pytest tests/compose

chaos: $(DEV_READY) ## every fault 20 times and 3 times in containers, every scenario, then half an hour of faults
	CHAOS=1 $(BIN)/pytest tests/chaos
	$(BIN)/loadgen run soak --out out/soak

bench: $(PEERS_READY) ## speed beside peers and limits; wants a machine with nothing else to do
	$(BIN)/python -m benchmarks

browser: $(DEV_READY) ## tests in a real browser; needs Chromium
	$(BIN)/pytest tests/browser

# On x86-64 PyPI's PyTorch brings gigabytes of CUDA: there it is left to whoever wants it.
TORCH := torch==2.13.0
torch: $(DEV_READY) ## PyTorch for the LSTM, where pip finds a build for the CPU alone
	@if test "$$(uname -m)" != x86_64 || $(BIN)/python -m pip install --quiet --dry-run --no-deps \
	  --ignore-installed --report - $(TORCH) 2>/dev/null | grep -q '"url".*cpu'; then \
	  $(BIN)/python -m pip install --quiet $(TORCH); \
	else echo "no build of $(TORCH) for the CPU alone: the LSTM's tests will be skipped"; fi

up: ## the three containers, then the robot's table; the server stays up
	docker compose up --build

down: ## remove the containers and their volumes
	docker compose down --volumes

table: $(BENCH_READY) ## Table II of the last demo
	$(BIN)/loadgen table out/demo/trace.jsonl --windows 5,10,20,30,40,50

wheel: $(DEV_READY) ## build dist/*.whl
	$(BIN)/python -m build --wheel

lock: ## pin every dependency with hashes
	$(PYTHON) requirements/lock.py

clean: ## remove what the targets made, but out/
	rm -rf $(VENV) $(CACHE) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BENCH_READY): requirements/bench.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/bench.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

$(DEV_READY): requirements/dev.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@ $(BENCH_READY)

$(PEERS_READY): requirements/peers.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements/peers.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@ $(DEV_READY) $(BENCH_READY)
