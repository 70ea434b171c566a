# make demo | test | lint | bench | clean; see the README. Overrides: PYTHON=python3.11 VENV=/some/where
VENV ?= .venv
PYTHON ?=
TESTS ?= test
JOBS ?= 2
BENCH ?= benchmarks
ARGS ?=

PY := $(VENV)/bin/python
READY := $(VENV)/.ready
TF2 := $(if $(wildcard test/build_tf2_msgs.sh),$(VENV)/.tf2_msgs)

# A sourced ROS install must not mix with the wheels of the virtual environment.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH LD_LIBRARY_PATH RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Without byte code every process compiles Open3D's and its own modules anew, which takes 5 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test lint docs bench soak config lock licences clean

help:
	@echo 'make demo    the live node registers a simulated Kinect and a simulated SfM cloud'
	@echo 'make test    every test (TESTS=test/io/test_files.py for some, JOBS=1 for one at a time)'
	@echo 'make lint    style, format, docstrings, types, docs'
	@echo 'make docs    build/docs/index.html by Sphinx'
	@echo 'make bench   measured figures, with their references beside them (hours; ARGS=--quick for minutes)'
	@echo 'make soak    the node under load for 20 minutes (ARGS="--minutes 5"): nothing may grow'
	@echo 'make licences  what an installation is made of (ARGS=--json for a CycloneDX bill of materials)'
	@echo 'make clean   remove what the others made, the virtual environment included'
	@echo 'PYTHON=...   interpreter to use (3.11 or 3.12)    VENV=...  where the environment lives'

setup: $(READY)

$(READY): requirements.lock setup.py setup.cfg .ci/bootstrap.sh
	@PYTHON='$(PYTHON)' .ci/bootstrap.sh '$(VENV)'

$(VENV)/.tf2_msgs: test/build_tf2_msgs.sh $(READY)
	@.ci/bootstrap.sh '$(VENV)' compiler
	@echo 'Building tf2_msgs from its interface files (about half a minute) ...'
	@test/build_tf2_msgs.sh '$(VENV)' && touch $@

demo: $(READY)
	@$(PY) -m csgm_ros.cli.main demo

test: $(READY) $(TF2)
	@$(PY) -m pytest -n $(JOBS) --dist loadfile $(TESTS)

lint: $(READY) docs
	@$(PY) -m ruff check . && $(PY) -m ruff format --check .
	@$(PY) -m numpydoc.hooks.validate_docstrings $$(git ls-files 'csgm_ros/*.py')
	@$(PY) -m mypy csgm_ros

docs: $(READY)
	@$(PY) -m sphinx -W --keep-going -q -b html docs build/docs

bench: $(READY)
	@set -e; for script in $$(grep -l __main__ $(BENCH)/*.py); do echo "== $$script"; $(PY) "$$script" $(ARGS); done

soak: $(READY)
	@cd test && ROS_DOMAIN_ID=99 $(abspath $(PY)) -m ros_helpers.soak $(ARGS)

licences: $(READY)
	@$(PY) .ci/licences.py $(ARGS)

config: $(READY)
	@$(PY) .ci/defaults.py

lock: $(READY)
	@.ci/lock.sh '$(VENV)' > requirements.lock.new && mv requirements.lock.new requirements.lock

clean:
	rm -rf '$(VENV)' build install log demo_output .pytest_cache .ruff_cache .hypothesis csgm_ros.egg-info
	find csgm_ros test benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
