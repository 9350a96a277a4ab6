# `make` alone says what there is. Everything runs in .venv, which `setup` makes and every other target brings up to date.

VENV := .venv/bin
# More test workers than this only fight for memory: each loads torch and Open3D.
WORKERS ?= 4
# Further arguments for pytest: make test ARGS="-k keypoints -x"
ARGS ?=

export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: help setup test test-slow test-lerobot demo check docs benchmark accuracy lock clean

help:
	@echo "make setup      .venv with the locked versions; system libraries too, or the command that brings them"
	@echo "make demo       the whole pipeline on two shipped recordings; ends with build/demo/report.html"
	@echo "make test       setup and the test suite"
	@echo "make test-slow  the tests that take long"
	@echo "make test-lerobot  the LeRobot export, read by the lerobot package in an environment of its own (8 GB)"
	@echo "make check      formatting, lint, types, layers, structure, rendered files, documentation"
	@echo "make docs       the documentation as a site: build/docs/index.html"
	@echo "make benchmark  speed of each stage compared with a plain implementation"
	@echo "make accuracy   accuracy of masks and matches, on simulated, ray-cast and real scenes (half an hour)"
	@echo "make lock       move requirements.lock to the newest versions"
	@echo "make clean      remove build/ and caches, not .venv"

setup:
	@.ci/setup

# A file stays with one worker: what its tests share, a rendered scene or a filled dataset, is made once.
test: setup
	$(VENV)/python -m pytest -n logical --maxprocesses $(WORKERS) --dist loadfile --durations 15 $(ARGS)

test-slow: setup
	$(VENV)/python -m pytest -m slow --timeout 7200 --durations 15 $(ARGS)

# lerobot asks for other versions than we do; 0.4.4 is the last for Python 3.11.
build/lerobot/bin/python:
	python3.11 -m venv build/lerobot && build/lerobot/bin/pip install --quiet lerobot==0.4.4

test-lerobot: setup build/lerobot/bin/python
	BASK_DATA_LEROBOT=$(CURDIR)/build/lerobot/bin/python $(VENV)/python -m pytest tests/export/test_lerobot.py

demo: setup
	$(VENV)/python pipelines/demo.py

check: setup docs
	$(VENV)/ruff format --check .
	$(VENV)/ruff check .
	$(VENV)/mypy
	$(VENV)/lint-imports
	$(VENV)/python .ci/structure.py
	$(VENV)/python benchmarks/keypoint_sets.py
	$(VENV)/python -m bask_data.schemas --check
	$(VENV)/python -m tests.cli.help_texts --check
	@set -e; for file in $(wildcard pipelines/*/dataset.json); do \
		echo "$(VENV)/bask-data dvc $$(dirname $$file) --check"; \
		$(VENV)/bask-data dvc $$(dirname $$file) --check; \
	done

# Strict: a link or an anchor that leads nowhere fails.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(VENV)/mkdocs build --strict --quiet

benchmark: setup
	$(VENV)/python benchmarks/run.py $(ARGS)

accuracy: setup
	$(VENV)/python benchmarks/accuracy.py $(ARGS)

lock: setup
	$(VENV)/python .ci/lock.py

clean:
	rm -rf build dist .pytest_cache .hypothesis .ruff_cache .mypy_cache .import_linter_cache
	find bask_data tests benchmarks pipelines .ci -name __pycache__ -type d -prune -exec rm -rf {} +
