"""Runs ``qs3`` many times, each in a process of its own that need not import its packages first.

One line of JSON on standard input asks for a command: arguments, environment, folder, files for its
output and seconds that it may take. The answer is a line with its exit code.
"""

import atexit
import gc
import importlib
import json
import os
import pkgutil
import signal
import sys

import numpy as np

import qs3.cli
from qs3.points.sampling import farthest_point_sample
from qs3.sensor.light.mitsuba import usable


def serve() -> list[str] | None:
    """Fork for each command; the child returns with its arguments, the server without."""
    for line in sys.stdin:
        asked = json.loads(line)
        child = os.fork()
        if child == 0:
            os.environ.clear()
            os.environ.update(asked["environment"])
            os.chdir(asked["folder"])
            for stream, name in ((0, os.devnull), (1, asked["out"]), (2, asked["err"])):
                flags = os.O_RDONLY if stream == 0 else os.O_WRONLY | os.O_CREAT
                os.dup2(os.open(name, flags), stream)
            signal.alarm(asked["seconds"])
            return asked["arguments"]
        _, status = os.waitpid(child, 0)
        os.write(1, f"{os.waitstatus_to_exitcode(status)}\n".encode())
    return None


def import_all() -> None:
    """Import and compile what verbs use, but for Mitsuba: its threads would not outlive a fork."""
    for name in ("torch._dynamo", "cv2", "matplotlib.figure", "scipy.stats", "trimesh", "tyro"):
        importlib.import_module(name)
    for module in pkgutil.walk_packages(qs3.__path__, "qs3."):
        if not module.name.endswith(("__main__", "_worker")):
            importlib.import_module(module.name)
    usable("scalar_rgb")
    assert "mitsuba" not in sys.modules
    farthest_point_sample(np.eye(3), 2)


if __name__ == "__main__":
    import_all()
    gc.freeze()
    arguments = serve()
    if arguments is not None:
        sys.argv = ["qs3", *arguments]
        try:
            qs3.cli.main()
        except SystemExit as end:  # without taking down, module by module, what the server imported
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(end.code or 0))
