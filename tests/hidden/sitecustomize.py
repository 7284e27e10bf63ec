"""Make the modules that ``QS3_HIDDEN`` names fail to load, as without their system libraries.

``.ci/run`` puts this folder on ``PYTHONPATH``, so that child processes lack them too.
"""

import importlib.abc
import importlib.util
import os
import sys


class _Hidden(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds such a module, as an installed one is found, and fails to load it."""

    def find_spec(self, name, path=None, target=None):
        hidden = name in os.environ.get("QS3_HIDDEN", "").split()
        return importlib.util.spec_from_loader(name, self) if hidden else None

    def create_module(self, spec):
        raise ImportError("libusb-1.0.so.0: cannot open shared object file: hidden", name=spec.name)

    def exec_module(self, module):
        raise AssertionError("never made")


sys.meta_path.insert(0, _Hidden())
