#!/bin/sh
# One command for the day a GPU is at hand: whole in 25 minutes, and run again it goes on.
#
#   benchmarks/gpu.sh [--out results/gpu] [--minutes 25]     what it measures: benchmarks/gpu.py
#   benchmarks/gpu.sh --cpu --tiny --out runs/tiny           tries every stage without a GPU
#   PYTHON=python3 benchmarks/gpu.sh                         uses that Python, and sets nothing up
set -eu
cd "$(dirname "$0")/.."
if [ -z "${PYTHON:-}" ]; then
    make .venv/.installed-dev
    PYTHON=.venv/bin/python
fi
exec "$PYTHON" benchmarks/gpu.py "$@"
