# make demo   one simulated experiment with the shipped actor, and its report as a page
# make test   style, types, and the tests: no root, no kernel, nothing outside .venv (six minutes on two processors)
# make hil    the programs as shipped on a real vcan0, with faults; needs user-mode-linux, gcc, libc6-dev, iproute2
# make browser   pages in a real browser: a run on its live page, a report on screen and on paper; needs chromium, pdftotext
# make night  what takes longer: slow tests, every fault, searches, fuzzing, all mutants
# make coverage   branch coverage of codec, guard, shield and state machine, which must be 100 %
# make mutation | mutation-changed   changes one place of them at a time, or of those that differ from BASE (main); each must make a test fail
# make compiled   the core of the cycle compiled, compared with its sources bit for bit, and run
# make package   wheels, with the compiled core and without, and sdist: checked, installed in an empty environment, run
# make job   the job of docs/howto/kernel-with-can.md with the wheels in dist/, in a clean root: its commands and exit codes
# make lint | docs | clean
# make study-thesis | study-reproduce   the thesis's analysis, its trainings (hours), into build/
# make figures   the rows of docs/figures.md, measured anew (a day)
# make proof   the shield's argument checked by machine for every brake of the set
# PYTHON=python3.12 picks the interpreter, VENV=DIR the place of the environment, WORKERS=N how many share the tests.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt
TORCH := $(shell grep '^torch==' constraints.txt)
BASE ?= main
WORKERS ?= $(shell n=$$(nproc); echo $$((n < 4 ? n : 4)))

.PHONY: help demo test pytest hil browser night compiled lint coverage mutation mutation-changed package job docs clean

help:
	@sed -n '/^$$/q; s/^# //p' Makefile

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "no $(PYTHON): sudo apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "$$($(PYTHON) --version) is too old: Python 3.11 or newer, e.g. make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| { echo "$(PYTHON) cannot make environments: sudo apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)

# What drives and analyses: no torch. pip is quiet: a line says what takes the time.
$(VENV)/.base: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing the bench into $(VENV): about a minute ..."
	$(PIP) -e '.[bench]'
	@touch $@

# torch first and pinned: left open, it is looked up anew, and may come with gigabytes of CUDA.
$(VENV)/.dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing everything, with torch, into $(VENV): some minutes ..."
	$(PIP) $(TORCH)
	$(PIP) -e '.[dev]'
	@touch $@ $(VENV)/.base $(VENV)/.docs

# The site's modules are read, not imported.
$(VENV)/.docs: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing mkdocs into $(VENV): half a minute ..."
	$(PIP) -e '.[docs]'
	@touch $@

demo: $(VENV)/.base
	@mkdir -p demo && rm -f demo/experiment.mcap demo/report.html
	$(BIN)/emb-run --iface sim --log demo/experiment.mcap --report demo/report.html
	@echo "open demo/report.html"

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m tools.style

PYTEST := $(BIN)/python -m pytest
PARALLEL := --numprocesses=$(WORKERS) --dist=worksteal --ignore=tests/hil
QUICK := 'not slow and not browser and not compiled'

# mypy takes one processor for a minute: the tests begin beside it.
test: $(VENV)/.dev
	$(MAKE) --jobs=2 --no-print-directory lint pytest
	@echo "not run here: programs on a vcan0 (make hil), pages in a browser (make browser), long tests and searches (make night)"

pytest: $(VENV)/.dev
	$(PYTEST) $(PARALLEL) -m $(QUICK)

browser: $(VENV)/.dev
	$(PYTEST) -m browser tests/bench/live tests/bench/report

# The plays in one worker, since one kernel plays them all; emb-hil itself in the other.
HIL := $(PYTEST) --numprocesses=2 --dist=loadfile --junitxml=build/hil.xml tests/hil

hil: $(VENV)/.dev
	@mkdir -p build && rm -f build/hil.xml
	$(HIL) -m 'not slow'
	$(BIN)/python .ci/hil_ran.py build/hil.xml

night: $(VENV)/.dev
	@mkdir -p build && rm -f build/hil.xml
	$(PYTEST) $(PARALLEL) -m slow
	$(HIL)
	$(BIN)/python .ci/hil_ran.py build/hil.xml
	$(BIN)/python -m tests.searches.shield --episodes 20000
	$(BIN)/python -m tests.searches.sensor_monitor --experiments 100000
	$(BIN)/python -m tests.searches.motion_balance --experiments 60000
	$(BIN)/python -m tests.searches.response --runs 100
	$(BIN)/python -m tests.searches.lies
	$(BIN)/python -m tests.searches.kills
	$(BIN)/python -m tests.searches.fuzz
	$(BIN)/python -m tests.searches.broken_files --count 2000
	$(BIN)/python -m tests.searches.interrupt
	$(PYTEST) $(PARALLEL) -m compiled tests/compiled --inputs 1000000 --timeout 7200
	$(BIN)/python -m proof
	$(BIN)/python -m tests.mutation

# The compiled core lies beside the sources afterwards. Beyond the values, which are compared bit for bit, the compiler may
# change what exceptions do: so the loop's faults are played on it too.
compiled: $(VENV)/.dev
	@mkdir -p build && rm -f build/compiled.mcap build/python.mcap
	$(BIN)/python -m tools.compile_core
	$(PYTEST) $(PARALLEL) -m compiled tests/compiled
	EMB_CORE=compiled $(BIN)/emb-run --iface sim --log build/compiled.mcap
	EMB_CORE=python $(BIN)/emb-run --iface sim --log build/python.mcap
	$(BIN)/python .ci/same_run.py build/compiled.mcap build/python.mcap
	EMB_CORE=compiled $(PYTEST) $(PARALLEL) -m 'not slow' -k 'not planted' tests/runtime/control

coverage: $(VENV)/.dev
	$(BIN)/python -m tests.mutation --coverage

mutation: $(VENV)/.dev
	$(BIN)/python -m tests.mutation

mutation-changed: $(VENV)/.dev
	$(BIN)/python -m tests.mutation --changed $(BASE)

WHEEL_PIP := build/wheel/bin/python -m pip install --disable-pip-version-check --quiet -c constraints.txt

# The wheel is installed where nothing else is, as on a bench computer.
package: $(VENV)/.dev
	rm -rf dist build/wheel
	$(BIN)/python -m build --outdir dist
	HATCH_BUILD_HOOK_ENABLE_CUSTOM=true $(BIN)/python -m build --wheel --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	for wheel in dist/*.whl; do $(BIN)/python .ci/package_files.py $$wheel || exit 1; done
	$(PYTHON) -m venv --clear build/wheel
	set -e; for extra in '' '[bench]' '[train]'; do \
		$(PYTHON) -m venv --clear build/wheel; \
		if [ "$$extra" = '[train]' ]; then $(WHEEL_PIP) $(TORCH); fi; \
		$(WHEEL_PIP) --find-links dist "emb-excite$$extra"; \
		case $$extra in \
		'[bench]') (cd build/wheel && bin/emb-run --iface sim --log run.mcap --report run.html);; \
		'[train]') (cd build/wheel && bin/emb-train --version && bin/emb-export step -o step.onnx);; \
		esac; \
	done
	$(PYTHON) -m venv --clear build/wheel
	$(WHEEL_PIP) dist/*-none-any.whl
	cd build/wheel && bin/emb-run --iface sim --log run.mcap && bin/emb-replay fim run.mcap
	$(WHEEL_PIP) --force-reinstall --no-deps dist/*-linux_*.whl
	cd build/wheel && bin/emb-run --iface sim --log compiled.mcap
	cd build/wheel && EMB_CORE=python bin/emb-run --iface sim --log fallback.mcap
	build/wheel/bin/python .ci/same_run.py build/wheel/compiled.mcap build/wheel/fallback.mcap

job: $(VENV)/.dev
	$(BIN)/python .ci/job.py dist

clean:
	rm -rf $(VENV) build dist demo .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The site, into build/site; it reads without a network.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "open build/site/index.html"

.PHONY: study-thesis study-reproduce figures proof

study-thesis: $(VENV)/.dev
	$(BIN)/python -m studies.thesis

# A day; python -m tools.figures TEXT measures some of them.
figures: $(VENV)/.dev
	$(BIN)/python -m tools.figures

study-reproduce: $(VENV)/.dev
	$(BIN)/python -m studies.thesis trainings --output build/trainings

proof: $(VENV)/.dev
	$(BIN)/python -m proof
