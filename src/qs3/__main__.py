"""``python -m qs3`` is the command ``qs3``."""

from qs3.cli import main

main()
