# `make demo` and `make test` set everything up themselves: a virtual environment, the packages.
#
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu    takes PyTorch's CPU build from there
#   make demo PYTHON=python3.12                                   uses another Python

PYTHON ?= python3
TORCH_INDEX ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Real meshes and scans for the tests that read them; those skip where it is absent.
QS3_SHARED_DATA ?= $(abspath $(wildcard ../shared/data))
export QS3_SHARED_DATA

.DELETE_ON_ERROR:
.PHONY: demo test slow check examples clean

demo: $(VENV)/.installed
	$(BIN)/qs3 demo --out demo

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q

slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -m slow

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

examples: $(VENV)/.installed
	set -e; for file in examples/*.py; do echo "$$file"; $(BIN)/python "$$file"; done

clean:
	rm -rf $(VENV) demo

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("qs3 needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Name another with: make demo PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo 'no virtual environment could be made; on Debian: apt-get install python3-venv'; exit 1; }

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) torch
	$(PIP) -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) -e '.[dev]'
	touch $@
