# Each target alone takes a fresh clone on a fresh Debian 12 (root or sudo) to a finished run.
# PYTEST_ARGS="-k friction -x" goes to pytest; DEMO=name chooses a demo; see scripts/ for the rest.
.PHONY: help setup test test-all lint demo docs dist test-debian13 test-wheels clean distclean
SHELL := /bin/bash
MAKEFLAGS += --no-print-directory
DEMO ?= two_blocks
export PYTEST_ARGS RUNS

help:
	@echo 'make setup          what the others do first: packages of Debian, .venv'
	@echo 'make test           lint, of each fast test the case of the week in serial, parallel ones on 2 ranks'
	@echo 'make test-all       what make test leaves out: slow tests and other cases, likewise'
	@echo '                    (.venv/bin/python -m pytest runs both in serial; -m "not slow" the fast)'
	@echo 'make demo           demos/$(DEMO).py on 2 ranks, output in out/$(DEMO) (DEMO=name for another)'
	@echo 'make docs           the site, in docs/_build/html; a warning is an error (RUNS=no: no pictures)'
	@echo 'make dist           sdist and wheel in dist/, checked by twine'
	@echo 'make lint           ruff and mypy'
	@echo 'make test-debian13  the fast tests on Debian 13 in a chroot (made once, some minutes)'
	@echo 'make test-wheels    the same with DOLFINx of PyPI, in .venv-wheels (PYTHON_WHEELS: which Python)'
	@echo 'make clean          remove .venv, caches and out/; the chroots stay (make distclean)'

setup:
	@scripts/setup.sh

test: setup
	@scripts/test.sh

test-all: setup
	@scripts/test.sh --slow

demo: setup
	@scripts/demo.sh $(DEMO)

docs: setup
	@scripts/docs.sh

dist:
	@scripts/dist.sh

lint: setup
	@scripts/lint.sh

test-debian13:
	@scripts/chroot.sh trixie

test-wheels:
	@scripts/wheels.sh

clean:
	rm -rf .venv .venv-lint .venv-wheels .pytest_cache .ruff_cache .mypy_cache build dist out *.egg-info docs/_build docs/made
	find . -name __pycache__ -type d -not -path './.git/*' -prune -exec rm -rf {} +

distclean: clean
	@scripts/chroot.sh --remove
