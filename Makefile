# make demo: a team of robots for half a minute.   make test: format, lint, types, layers, tests.
# make quick: the tests of the core and of what runs in memory.   make bench: what a cycle costs.
# CONTRIBUTING.md lists every target, with the time that it takes.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
COMPILED = build/compiled
# Where it is set, each process that the tests start compiles whatever it imports once more.
export PYTHONDONTWRITEBYTECODE =

.PHONY: setup peers demo test quick check unit test-thorough test-long test-recordings test-ros2 test-trial test-compiled test-docker test-bench \
  chaos net recording fuzz luck compiled bench bench-degraded bench-detection bench-latency bench-pictures \
  bench-processes bench-scaling bench-view bench-pairs bench-mapping screenshot clean

setup: $(VENV)/ready

$(VENV)/ready: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV): one to three minutes, the first time only"
	$(BIN)/python -m pip install --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: setup
	$(BIN)/cpcbl-team up --view

# Side by side: mypy has one thread.
test: setup
	$(MAKE) --no-print-directory -j 2 check unit

# The core and what runs in memory: no process, no Zenoh session, no camera, no experiment; and not the
# table of drivers' mistakes, for whoever changes agents/cpcbl_agents/input_diagnosis.
quick: setup
	$(BIN)/pytest -n 2 -q -m "$(USUAL) and not process" tests/core tests/net tests/transport \
	  tests/agents tests/launch/reporting --ignore tests/agents/vision \
	  --ignore tests/agents/test_driver_mistakes.py --ignore tests/agents/test_weak_motion.py \
	  --ignore tests/agents/test_good_drivers.py

check: setup
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	PYTHONPATH=.:agents:transport:launch $(BIN)/lint-imports --no-cache

# One worker more than cores: many tests wait for the processes that they started. Each worker finds
# all tests anew. In a new clone each would compile them as well, at the same time.
unit: $(VENV)/compiled-tests
	$(BIN)/pytest -n 3 --dist worksteal -m "$(USUAL)"

$(VENV)/compiled-tests: $(VENV)/ready
	@$(BIN)/pytest --collect-only -q > /dev/null 2>&1 || true  # what is wrong, the next run says
	@touch $@

# More worlds, seeds, images and attacks than `make test` samples, with the same bounds, and four times
# the examples of properties.
test-thorough: setup
	$(BIN)/pytest -n 2 --dist worksteal --hypothesis-profile thorough -m "(thorough or hypothesis) and not long"

USUAL = not thorough and not long and not log and not pictures and not docker and not trial and not ros2 and not recordings

# Minutes long; with CPCBL_MRCLAM=folder also on real logs, with CPCBL_PICTURES=folder real pictures.
test-long: setup
	$(BIN)/pytest -n 2 -m "long$(if $(CPCBL_MRCLAM), or log)$(if $(CPCBL_PICTURES), or pictures)"

# Independent implementations of ROS 2, from wheels for Python 3.11, in a venv of their own.
PARTNERS = build/ros2-partners
PARTNERS_PYTHON ?= python3.11
test-ros2: setup $(PARTNERS)/ready
	CPCBL_ROS2=$(PARTNERS) $(BIN)/pytest -n 2 -m ros2 tests/ros2

$(PARTNERS)/ready: tests/ros2/partners.txt
	$(PARTNERS_PYTHON) -m venv $(PARTNERS)
	$(PARTNERS)/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

# Programs of others that read merged runs, in a venv of their own.
READERS = build/recording-readers
test-recordings: setup $(READERS)/ready
	CPCBL_PARTNERS=$(READERS) $(BIN)/pytest -n 2 -m recordings tests/recordings

$(READERS)/ready: tests/recordings/partners.txt
	$(PYTHON) -m venv $(READERS)
	$(READERS)/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

# What a new user does, with a browser; needs Chromium (Debian: apt-get install chromium). By file: one
# has a team that all of its tests share, another one fixed ports.
test-trial: setup
	$(BIN)/pytest -n 2 --dist loadfile -m trial

# The core's tests with its hot files compiled, and that they say the same.
test-compiled: compiled
	$(BIN)/pytest -o pythonpath="$(COMPILED) agents transport launch tests" -n 2 tests/core
	$(BIN)/pytest tests/benchmarks/test_compiled.py

# Needs a Docker daemon: docker/dockerd.sh start. One at a time: containers share the machine.
test-docker: setup
	$(BIN)/pytest -m docker

# Every fault scenario; those that need root or Docker say so where there is none.
chaos: setup
	$(BIN)/cpcbl-team chaos all --retries 1 --at-once 3

# The net proves that a refactoring changes no bit; see tests/net/test_net.py.
net: setup
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m net.reference

# A day of team time with bad luck (docs/luck.md), with the compiled core, which is built anew only
# when it is missing or older than its sources. ARGS='--seeds 200': a part of it.
luck: $(COMPILED)/ready
	PYTHONPATH=agents:transport:launch:$(COMPILED) $(BIN)/cpcbl-team experiment luck --seeds 1440 --output build $(ARGS)

# Meaningless payloads on every key of a running team: some minutes.
fuzz: setup
	$(BIN)/pytest -q tests/fuzz

# The recording that the tests replay, anew, with what has moved; see tests/support/kept_recording.py.
recording: setup
	PYTHONPATH=$(BENCH_PATH) PYTHONHASHSEED=0 $(BIN)/python -m support.kept_recording

# The core with its hot files compiled (hatch_build.py), and the benchmarks' yardstick: beside the
# checkout's own, which stay as they are. Needs a C compiler.
compiled: $(COMPILED)/ready

$(COMPILED)/ready: $(VENV)/ready hatch_build.py $(wildcard cpcbl_team/*.py cpcbl_team/config/*.py) tests/benchmarks/float_ekf.py
	rm -rf $(COMPILED)
	HATCH_BUILD_HOOKS_ENABLE=1 $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --no-deps --target $(COMPILED) .
	mkdir $(COMPILED)/benchmarks
	cp tests/benchmarks/float_ekf.py $(COMPILED)/benchmarks
	cd $(COMPILED) && MYPYPATH=../../tests $(abspath $(BIN))/mypyc --namespace-packages \
	  --explicit-package-bases --ignore-missing-imports benchmarks/float_ekf.py > mypyc.log
	@touch $@

# What the benchmarks compare with: the extra `bench`.
peers: $(VENV)/peers

$(VENV)/peers: $(VENV)/ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,bench]'
	@touch $@

# The variants of the localizer and their peers compute the same; so do a cluster and this machine.
test-bench: peers compiled
	$(BIN)/pytest -q tests/benchmarks/test_contenders.py tests/benchmarks/test_compiled.py \
	  tests/benchmarks/test_viewers.py tests/benchmarks/test_mapping.py tests/launch/lab/test_seeds.py

# Timed, so alone on the machine: the localizer's variants and their peers in the same run, then a
# robot's detector and OpenCV's marker detection.
bench: test-bench
	@mkdir -p build
	$(call timed,cycle,bench)
	$(call timed,eyes,bench_eyes)
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.table build/bench_raw.json build/bench.json
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.eyes_table build/bench_eyes_raw.json build/bench_eyes.json

# Measurements, each with options of its own (ARGS=--help). Real processes over Zenoh, alone on the
# machine: latency, processes (ARGS='--team-sizes 40,48,60 --old ../earlier-checkout'). In one process:
# scaling (teams of any size), detection (rendered frames), pictures (ARGS='SET FOLDER': real ones).
bench-detection bench-latency bench-pictures bench-processes bench-scaling bench-pairs: setup
	@mkdir -p build
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.$(@:bench-%=%) $(ARGS)

# A robot's detector beside two others on frames of a bad camera; ARGS='--family aruco_4x4_50'.
bench-degraded: peers
	@mkdir -p build
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.degraded $(ARGS)

# `calibrate map` beside GTSAM; ARGS='MRCLAM2 MRCLAM4 --known 6,20 --team'.
bench-mapping: peers
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.mapping $(ARGS)

# The view with teams of 4, 50 and 200 robots in Chromium; docs/view.png, a picture of the demo, and
# docs/report.png, of its report (ARGS=report: that alone).
bench-view: setup
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.view_load $(ARGS)

screenshot: setup
	PYTHONPATH=$(BENCH_PATH) $(BIN)/python -m benchmarks.view_picture $(ARGS)

BENCH_PATH = .:agents:transport:launch:tests
timed = $(BIN)/pytest -q --benchmark-json=build/$(2)_raw.json --benchmark-columns=median \
  --benchmark-timer=time.process_time --benchmark-sort=name tests/benchmarks/bench_$(1).py \
  > build/$(2).log || { cat build/$(2).log; exit 1; }

clean:
	rm -rf $(VENV) build .pytest_cache .mypy_cache .ruff_cache .hypothesis
