# `make demo` and `make test` do everything from a fresh clone. PYTHON picks the interpreter (CPython 3.11 or 3.12).

SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))
PYTHON ?= $(shell for p in python3.12 python3.11 python3 python; do $$p -c '$(SUPPORTED)' 2>/dev/null && { echo $$p; break; }; done)
VENV ?= .venv
NUMPY1_VENV := .venv-numpy1
PACKAGES := $(patsubst %/setup.py,%,$(wildcard src/*/setup.py))
BUILD_FILES := $(wildcard src/*/setup.py src/*/setup.cfg src/*/pyproject.toml)
INSTALL := -m pip install --quiet --disable-pip-version-check
BIN := $(VENV)/bin
# Where the tests, too, look for it by default.
RECORDING := ../shared/data/keyboard_short
# Tests start ROS graphs of their own: they must not meet those of others on the network.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

.PHONY: demo test test-all lint format bench bench-estimator bench-goals bench-graph bench-calibration bench-random bench-scenes pictures calibration-pictures venv config lock clean

demo: venv
	$(BIN)/vli demo

venv: $(VENV)/.installed

$(VENV)/.installed: requirements.txt requirements-dev.txt requirements.lock $(BUILD_FILES)
	@test -n "$(PYTHON)" || { echo "no CPython 3.11 or 3.12 found; name one: make venv PYTHON=/path/to/python3.12" >&2; exit 2; }
	@echo "installing into $(VENV) (about two minutes)" >&2
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python $(INSTALL) -r requirements.txt -r requirements-dev.txt -c requirements.lock
	$(BIN)/python $(INSTALL) --no-build-isolation $(addprefix -e ,$(PACKAGES)) -c requirements.lock
	$(BIN)/python -m vli_bringup.warm_up
	@touch $@

test: lint
	$(BIN)/python -m pytest -m "not slow"

test-all: lint $(NUMPY1_VENV)/.installed
	$(BIN)/python -m pytest
	$(NUMPY1_VENV)/bin/python -m pytest -m "not slow and not lint"

$(NUMPY1_VENV)/.installed: requirements-numpy1.lock $(BUILD_FILES)
	$(PYTHON) -m venv $(NUMPY1_VENV)
	$(NUMPY1_VENV)/bin/python $(INSTALL) -r requirements-numpy1.lock
	$(NUMPY1_VENV)/bin/python $(INSTALL) --no-build-isolation --no-deps $(addprefix -e ,$(PACKAGES))
	@touch $@

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: venv
	@for script in $(filter-out %/bench_estimator.py %/bench_graph.py %/bench_random.py,$(wildcard test/perf/bench_*.py)); do \
		echo "== $$script"; \
		test -d $(RECORDING) || { echo "skipped: needs the recording '$(RECORDING)'"; continue; }; \
		$(BIN)/python $$script || failed=1; \
	done; exit $${failed:-0}

# The pictures of the README: cloud and mesh of the scan in bags/.
pictures: venv
	$(BIN)/python docs/pictures.py docs/images

# Which stage limits: each gets the truth in turn.
bench-estimator: venv
	$(BIN)/python test/perf/bench_estimator.py

# Accuracy against the project's goals; makes its recordings first.
bench-goals: venv
	$(BIN)/python test/perf/goals.py

# The node graph against its bars: losses, latency, pace, overhead, crashes, stops, and 30 minutes of soak.
bench-graph: venv
	$(BIN)/python test/perf/bench_graph.py

# The whole table of real and simulated sets; under an hour on two idle cores.
bench-calibration: venv
	$(BIN)/python test/perf/bench_calibration.py --full

# The pictures of docs/calibration.md.
calibration-pictures: venv
	$(BIN)/python docs/calibration_pictures.py docs/images

# Forty random scenes, the usual ones and the hard ones; an hour and a half to make.
bench-random: venv
	$(BIN)/python test/perf/bench_random.py
	$(BIN)/python test/perf/bench_random.py --ranges wide --first 8001

bench-scenes: venv
	$(BIN)/python test/perf/scenes.py

config: venv
	$(BIN)/python -m vli_bringup.settings > config/vli.yaml
	$(BIN)/python -m vli_bringup.access > config/sros2/vli.policy.xml

lock:
	$(PYTHON) .ci/lock.py

clean:
	rm -rf $(VENV) $(NUMPY1_VENV) build install log
