# Every command of the project. `make` alone lists them.
# Variables: PYTHON (interpreter to build .venv with), ARGS (passed on to the command).

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup demo test lint format blind validate bench bench-denoise bench-diagnose stalls trust fuzz kill soak audit \
	screenshots gallery docs package clean

export PYTHON
PY := .venv/bin/python
# One file's tests stay in one process, so module fixtures and compiled functions are made once. Files are taken up in
# their order: by their numbers of tests the slowest would come last, and the other processes wait for them.
PYTEST_ARGS ?= -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations=15 -o faulthandler_timeout=300

help: ## list the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-14s %s\n", $$1, $$2 }' Makefile

setup: ## .venv, all Python packages, missing system libraries (apt when root)
	@tools/setup.sh all,formats,test,docs

demo: setup ## the main job without a screen: hide an effect, find it from the files alone; writes demo/
	.venv/bin/napari-mufasa demo --out demo --overwrite $(ARGS)

test: lint ## lint, then the whole test suite under Xvfb, pages and their code included
	tools/run-tests.sh $(PYTEST_ARGS) $(ARGS)

lint: setup ## ruff format, ruff check, mypy
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .
	$(PY) -m mypy

format: setup ## let ruff format and fix what it can
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

blind: setup ## the hidden-effect trial (hours); ARGS="--table build/trial.jsonl" for its page, ARGS=--quick for a slice
	$(PY) -m tests.blind.trial $(ARGS)

validate: setup ## the physics against known answers
	$(PY) -m benchmarks.validate $(ARGS)

bench: setup ## speed as ratios, growth and memory; writes benchmarks/results/speed.md; ARGS=--quick for a minute
	$(PY) -m benchmarks.speed $(ARGS)

bench-denoise: setup ## denoisers against ground truth and against BM3D
	@tools/setup.sh bench
	$(PY) -m benchmarks.denoise $(ARGS)

bench-diagnose: setup ## time and memory of a diagnosis against their limits
	$(PY) -m benchmarks.diagnosis $(ARGS)

stalls: setup ## how long the interface stands still, and what napari's start costs with the plugin
	tools/run-tests.sh benchmarks/test_stalls.py -q -s --show-capture=no $(ARGS)
	xvfb-run -a -s "-screen 0 1600x1000x24" $(PY) -m benchmarks.startup

trust: fuzz kill soak audit ## all of the next four: hostile input, broken files, long runs (two hours)

fuzz: setup ## feed the readers and the model parser with made-up files, 15 minutes each
	@tools/setup.sh trust
	$(PY) tools/fuzz.py $(ARGS)

kill: setup ## kill -9 at random moments of long writes: whole files, or none
	$(PY) tools/kill.py $(ARGS)

soak: setup ## 200 rounds of simulate, denoise, extract, diagnose: memory and threads stay
	$(PY) tools/soak.py $(ARGS)

audit: setup ## known vulnerabilities of the installed packages, where the network allows
	@tools/setup.sh trust
	$(PY) tools/audit.py $(ARGS)

screenshots: setup ## pictures of the viewer, drawn under Xvfb
	xvfb-run -a -s "-screen 0 1600x1000x24" $(PY) tools/screenshots.py $(ARGS)

gallery: setup ## pictures of the gallery and of the effects, into docs/images/
	for script in protocols runtime distances trial real fingerprints; do $(PY) docs/gallery/$$script.py $(ARGS); done

docs: setup ## the documentation, into site/
	$(PY) tools/effects_page.py > docs/.effects.md && mv docs/.effects.md docs/effects.md
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict $(ARGS)

package: setup ## wheel and sdist into dist/, checked, installed into an empty environment and run
	@tools/setup.sh release
	tools/package.sh

clean: ## remove what the commands made, except .venv
	rm -rf demo site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
