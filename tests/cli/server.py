"""Runs ``qs3`` many times, each in a process of its own that need not import PyTorch first.

One line of JSON on standard input asks for a command: arguments, environment, folder, files for its
output and seconds that it may take. The answer is a line with its exit code.
"""

import json
import os
import signal
import sys


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


if __name__ == "__main__":
    import torch  # noqa: F401
    import tyro  # noqa: F401

    import qs3.training  # noqa: F401
    from qs3.cli import main

    arguments = serve()
    if arguments is not None:
        sys.argv = ["qs3", *arguments]
        main()
