# `make demo` and `make test` set up all they need, in .venv; the second time they start at once.
# What only lint and tests need, three times as much, comes when they are first run.

VENV := .venv
PYTHON_IN_VENV := $(VENV)/bin/python
READY := $(VENV)/ready-on-$(or $(ROS_DISTRO),$(ROS_WHEELS:%=%-wheels),wheels)
READY_TO_DEVELOP := $(READY)-to-develop
CORE := $(VENV)/core-is-built

ifdef ROS_DISTRO
PIP_LIMITS = "numpy==$$($(PYTHON_IN_VENV) -c 'import numpy; print(numpy.__version__)')"
else
PIP_LIMITS := $(if $(ROS_WHEELS),,--constraint constraints.txt)
# where ament_index finds the wheels' packages
export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)
endif
# without bytecode each of the hundreds of programs that tests start compiles the package anew
export PYTHONDONTWRITEBYTECODE :=
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
# make was started by a Python with ROS wheels of its own, whose libraries must not be used here
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
endif

LOCK = $(VENV)/bin/uv pip compile --quiet --universal --generate-hashes --python-version 3.10 \
	--constraint constraints.txt --custom-compile-command 'make lock'

.DEFAULT_GOAL := help
.PHONY: help demo robot test lint format pytest sanitize colcon docs benchmark benchmark-accuracy venv \
	develop lock clean

help:  ## list these targets
	@sed -n 's/^\([a-z-]*\):.*##/\1:/p' $(MAKEFILE_LIST) | column -t -s:

demo: $(READY) $(CORE)  ## run simulator and observer until they converge; pictures in demo_output/
	$(PYTHON_IN_VENV) demo/demo.py

robot: $(READY) $(CORE)  ## localise a simulated robot among AprilTags, as for Nav2; OPTIONS=--help
	$(PYTHON_IN_VENV) demo/robot.py $(OPTIONS)

test: $(READY_TO_DEVELOP) $(CORE)  ## everything that a change must pass
	$(MAKE) --jobs=2 lint colcon
	$(MAKE) pytest

lint: $(READY_TO_DEVELOP)  ## ruff, mypy --strict, the layers of the architecture
	$(VENV)/bin/ruff check --no-cache
	$(VENV)/bin/ruff format --no-cache --check
	$(VENV)/bin/mypy --cache-dir $(VENV)/mypy-cache
	$(VENV)/bin/lint-imports --no-cache

format: $(READY_TO_DEVELOP)  ## let ruff mend style and layout
	$(VENV)/bin/ruff check --no-cache --fix
	$(VENV)/bin/ruff format --no-cache

# The tests of one file share nodes and a ROS domain; those of two have nothing in common, and come
# in the order of test/conftest.py. Tests that wait for nodes leave cores to others.
pytest: $(READY_TO_DEVELOP) $(CORE)  ## the tests alone
	scripts/ensure_chromium.sh
	$(PYTHON_IN_VENV) -m pytest --numprocesses 4 --dist loadfile --no-loadscope-reorder

sanitize: $(READY_TO_DEVELOP)  ## look longer than the tests for reads and writes out of bounds in C
	PYTHONPATH=$(CURDIR) $(PYTHON_IN_VENV) test/helpers/sanitized.py 1000

colcon: $(READY_TO_DEVELOP)  ## build, install and test as a ROS workspace does
	scripts/colcon_check.sh $(VENV)

docs: $(READY_TO_DEVELOP)  ## rewrite the tables, build the site into site/, check its links
	$(PYTHON_IN_VENV) -m pip install --quiet $(PIP_LIMITS) --editable '.[docs]'
	$(PYTHON_IN_VENV) scripts/write_docs.py
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict

benchmark-accuracy: $(READY_TO_DEVELOP)  ## compare with GTSAM's iSAM2 on real recordings
	$(PYTHON_IN_VENV) -m pip install --quiet $(PIP_LIMITS) --editable '.[benchmark]'
	$(PYTHON_IN_VENV) benchmark/accuracy.py

benchmark: $(READY_TO_DEVELOP) $(CORE)  ## what it costs, as ratios; rewrites docs/performance.md
	$(PYTHON_IN_VENV) -m pip install --quiet $(PIP_LIMITS) --editable '.[benchmark]'
	$(PYTHON_IN_VENV) benchmark/performance.py --write-docs

venv: $(READY)  ## only set up .venv, for nodes and command line

develop: $(READY_TO_DEVELOP)  ## add to it what lint and tests need

lock: $(READY_TO_DEVELOP)  ## write requirements*.lock, the hashes of what constraints.txt names
	$(PYTHON_IN_VENV) -m pip install --quiet uv
	$(LOCK) --extra cli --extra ros-jazzy --output-file requirements.lock setup.py
	$(LOCK) --extra cli --extra cluster --extra test --extra dev --extra ros-jazzy \
		--output-file requirements-develop.lock setup.py

$(READY): setup.py constraints.txt requirements.lock \
		$(wildcard scripts/setup_venv.sh scripts/build_tf2_msgs.py)
	scripts/setup_venv.sh $(VENV)
	touch $@ $(CORE)

$(READY_TO_DEVELOP): $(READY) requirements-develop.lock
	scripts/setup_venv.sh $(VENV) develop
	touch $@

# Where there is a compiler; it is built with the rest at first, and again when it changes.
$(CORE): $(wildcard slam_observer_ros/*/_*.[ch]) | $(READY)
	$(PYTHON_IN_VENV) setup.py --quiet build_ext --inplace
	touch $@

clean:  ## remove all that make made, but demo_output
	rm -rf $(VENV) build install log site *.egg-info .hypothesis slam_observer_ros/*/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
