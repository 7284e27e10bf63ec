# `make demo` and `make test` set everything up themselves: a virtual environment, the packages.
#
#   make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu    takes PyTorch's CPU build from there
#   make demo PYTHON=python3.12                                   uses another Python
#   make demo CAD=my_cad SCANS=my_scans                           the same on your own parts
#   make cycles                                                   brings the paper's renderer (docs/cycles.md)

PYTHON ?= python3
TORCH_INDEX ?=
PYTHON_CYCLES ?= python3.11
VENV := .venv
VENV_CYCLES := .venv-cycles
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Real meshes and scans for the tests that read them; those skip where it is absent.
QS3_SHARED_DATA ?= $(abspath $(wildcard ../shared/data))
export QS3_SHARED_DATA

# Else each of the many processes of the tests compiles what it imports anew.
unexport PYTHONDONTWRITEBYTECODE

.DELETE_ON_ERROR:
.PHONY: demo test slow check examples docs cycles clean

demo: $(VENV)/.installed
ifneq ($(CAD)$(SCANS),)
	$(BIN)/qs3 adapt "$(CAD)" "$(SCANS)" --out demo-own
	test -e demo-own/labels.csv || $(BIN)/qs3 suggest demo-own/run "$(SCANS)" --out demo-own/labels.csv
else
	$(BIN)/qs3 demo --out demo
endif

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -n auto --dist loadfile --max-worker-restart 0

slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -m slow --timeout 3600 -n auto --dist loadfile --max-worker-restart 0

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

examples: $(VENV)/.installed-dev
	set -e; for file in examples/[0-9]*.py; do echo "$$file"; $(BIN)/python "$$file"; done
	$(BIN)/python -m pytest -q -m slow tests/test_notebook.py

# The site, in site/; needs no network once the packages are there.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Blender's module needs one version of Python and an old NumPy, hence an environment of its own.
cycles: $(VENV_CYCLES)/.installed
	@$(VENV_CYCLES)/bin/python -c 'import bpy; print("Cycles: Blender " + bpy.app.version_string)'

clean:
	rm -rf $(VENV) $(VENV_CYCLES) demo demo-own site

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("qs3 needs Python 3.11 or newer; this is " + sys.version.split()[0] + ". Name another with: make demo PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo 'no virtual environment could be made; on Debian: apt-get install python3-venv'; exit 1; }

# One call of pip each. `make .venv/.installed-dev EXTRAS=llvm,dev,docs` brings all of them in one.
$(VENV)/.installed: EXTRAS = llvm
$(VENV)/.installed-dev: EXTRAS = llvm,dev
$(VENV)/.installed-docs: EXTRAS = docs

$(VENV)/.installed $(VENV)/.installed-dev $(VENV)/.installed-docs: $(BIN)/python pyproject.toml constraints.txt
	$(if $(TORCH_INDEX),$(PIP) --index-url $(TORCH_INDEX) torch)
	$(PIP) -e '.[$(EXTRAS)]'
	touch $@

$(VENV_CYCLES)/bin/python:
	@$(PYTHON_CYCLES) -c 'import sys; sys.exit("Cycles needs Python 3.11; this is " + sys.version.split()[0]) if sys.version_info[:2] != (3, 11) else None' || { echo 'name a Python 3.11 with: make cycles PYTHON_CYCLES=/path/to/python3.11'; exit 1; }
	$(PYTHON_CYCLES) -m venv $(VENV_CYCLES) || { rm -rf $(VENV_CYCLES); echo 'no virtual environment could be made; on Debian: apt-get install python3-venv'; exit 1; }

$(VENV_CYCLES)/.installed: $(VENV_CYCLES)/bin/python constraints-cycles.txt
	$(VENV_CYCLES)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-cycles.txt bpy numpy
	touch $@
