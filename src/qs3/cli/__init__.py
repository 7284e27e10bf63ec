"""The one command, ``qs3``, and its verbs.

Results (paths, scores, tables) go to standard output, messages to standard error. An error that a
user can correct is one line and exit code 2; Ctrl-C ends with 130.
"""

import contextlib
import errno
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType

VERBS = {
    "adapt": "Make a classifier of your own parts: CAD and unlabelled scans in, answers out.",
    "scan": "Scan one mesh: noisy cloud, clean twin, a picture of every stage.",
    "sensors": "List the sensors, or show one as TOML to copy and edit.",
    "realism": "Compare a simulated camera's matcher with a real camera's own depth.",
    "meshes": "Show what a folder of meshes holds: classes, sizes, faults, a contact sheet.",
    "locate": "Find the part in each scan: class, CAD file, pose, residual and visible share.",
    "find": "Find the parts on a table in depth pictures: class and pose of each.",
    "generate": "Scan many meshes into a data set; resumes, and logs what failed.",
    "merge": "Put the parts that `qs3 generate --shard i/n` made into one data set.",
    "info": "Print what a data set holds: counts, sizes, statistics of the sensor, failures.",
    "convert": "Convert a data set into the layout of another.",
    "capture": "Write the frames of a depth camera, live or recorded, as files.",
    "extract": "Cut objects out of real scans into a data set.",
    "segment": "Cut scans of a table or a floor into the objects that stand on it.",
    "train": "Train a classifier; a method may adapt it to an unlabelled target.",
    "evaluate": "Score a run: accuracy, class-mean accuracy, confusion matrix.",
    "predict": "Predict the class of each file, with its confidence.",
    "suggest": "Pick uncertain scans to label, and write a CSV to fill in.",
    "watch": "Print the objects or parts before a depth camera, frame by frame.",
    "export": "Export a network as ONNX.",
    "reproduce": "Make tables and figures, with their data and trainings.",
    "table": "Print a table, ours beside the published figures, from records alone.",
    "figure": "Draw the figure of a table from records alone.",
    "report": "Write one self-contained HTML page about a run.",
    "view": "Step through a data set, a run's answers or one cloud in a browser, until Ctrl-C.",
    "doctor": "Print what works on this machine and how to get what does not.",
    "demo": "Make a classifier of parts from their CAD, in steps that are printed as commands.",
}
"""Help of each verb; a module of that name has its function."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb and exit with its code."""
    from qs3.cli.text import is_unread, notify, prepare_streams, printable

    prepare_streams()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with contextlib.suppress(ValueError):  # not the main thread
            signal.signal(signal.SIGINT, interrupt)
    try:
        code = run(list(sys.argv[1:] if arguments is None else arguments))
        code = 141 if is_unread() else code
    except KeyboardInterrupt as stop:
        notify(f"qs3: stopped; {str(stop) or 'run the same command again to continue'}")
        code = 130
    except BrokenPipeError:
        code = 141  # the reader of a bar of progress went away
    except Exception as error:
        line = _line_of(error)
        if line is None:
            raise
        notify(f"qs3: {printable(line, keep='')}")
        code = 2
    sys.exit(code)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; if compiled code of Numba packs its result, in the line after.

    Numba drops an error that arises there, and the call ends in a SystemError.
    """

    def stop(*_: object) -> None:
        sys.settrace(None)
        raise KeyboardInterrupt

    while frame is not None and frame.f_code.co_name != "_numba_unpickle":
        frame = frame.f_back
    if frame is None or frame.f_back is None:
        raise KeyboardInterrupt
    frame.f_back.f_trace = stop
    sys.settrace(lambda *_: None)


def _line_of(error: Exception) -> str | None:
    """Return the message of an error that a user can correct; None for a bug."""
    from qs3.errors import QS3Error

    if isinstance(error, QS3Error):
        return str(error)
    if not isinstance(error, OSError):
        return None
    line = f"{error.filename or 'file system'}: {error.strerror or error}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        line += "; make room, then run the same command again"
    return line


def run(words: list[str]) -> int:
    """Import and run the verb that is asked for, and nothing else: a scan starts fast."""
    from qs3.cli.text import notify, show

    verb, *rest = words or [""]
    if verb in ("", "-h", "--help"):
        (show if verb else notify)(_help())
        return 0 if verb else 2
    if verb == "--version":
        from importlib.metadata import version

        show(f"qs3 {version('qs3')}")
        return 0
    from qs3.errors import no_such

    if verb not in VERBS:
        raise no_such(f"{verb}: no such verb", verb, VERBS, "; see qs3 --help")
    from qs3.cli.options import run_verb

    if modules := os.environ.get("QS3_IMPORT"):  # of networks and methods outside of qs3
        from qs3.lazy import import_from

        import_from(*modules.split(","))
    return run_verb(verb, VERBS[verb], rest)


def _help() -> str:
    head = "usage: qs3 [--help] [--version] VERB [OPTIONS]"
    purpose = "CAD models to a classifier that works on a real depth camera."
    lines = [f"  {verb:10} {text}" for verb, text in VERBS.items()]
    return "\n".join([head, "", purpose, "", *lines, "", "The options of a verb: qs3 VERB --help"])
