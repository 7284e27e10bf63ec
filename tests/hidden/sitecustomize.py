"""Make the modules that ``QS3_HIDDEN`` names fail to import, as without their system libraries.

``.ci/run`` puts this folder on ``PYTHONPATH``, so that child processes lack them too.
"""

import importlib.abc
import os
import sys


class _Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in os.environ.get("QS3_HIDDEN", "").split():
            raise ImportError("libusb-1.0.so.0: cannot open shared object file: hidden", name=name)


sys.meta_path.insert(0, _Hidden())
