"""The one command, ``qs3``, and its verbs.

Standard output carries results (paths, scores, tables); standard error carries talk. A fault that
a user can mend is one line on standard error and exit code 2; Ctrl-C ends with 130.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Annotated


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; the exit code says how it ended."""
    import tyro

    from qs3.errors import QS3Error

    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = tyro.extras.subcommand_cli_from_dict(
            _verbs(given),
            prog="qs3",
            description="CAD models to a classifier that works on a real depth camera.",
            args=given,
        )
    except QS3Error as error:
        print(f"qs3: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("qs3: stopped; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our output went away (`qs3 … | head`): nothing to tell it.
        sys.stderr.close()
        sys.exit(141)
    except OSError as error:
        reason = error.strerror or str(error)
        print(f"qs3: {error.filename or 'file system'}: {reason}", file=sys.stderr)
        sys.exit(2)
    sys.exit(code or 0)


def _verbs(given: list[str]) -> dict[str, Callable[..., int]]:
    """The verbs; only what the one asked for needs is imported, so that a scan starts fast."""
    from qs3.cli.convert import convert
    from qs3.cli.doctor import doctor
    from qs3.cli.extract import extract
    from qs3.cli.generate import generate
    from qs3.cli.realism import realism
    from qs3.cli.scan import scan
    from qs3.cli.sensors import sensors
    from qs3.cli.store import info, merge, verify
    from qs3.cli.view import view

    verbs: dict[str, Callable[..., int]] = {
        "scan": scan,
        "sensors": sensors,
        "realism": realism,
        "generate": generate,
        "merge": merge,
        "info": info,
        "verify": verify,
        "convert": convert,
        "extract": extract,
        "view": view,
        "doctor": doctor,
    }
    if given and given[0] in verbs:
        return verbs
    import tyro

    from qs3.cli.demo import demo
    from qs3.cli.evaluate import evaluate_run, predict
    from qs3.cli.export import export
    from qs3.cli.report import report
    from qs3.cli.reproduce import reproduce
    from qs3.cli.table import figure, table
    from qs3.cli.train import TrainOptions, preset_options, train

    defaults = preset_options(given)

    def train_with_preset(
        options: Annotated[TrainOptions, tyro.conf.arg(name="")] = defaults,
    ) -> int:
        return train(options)

    train_with_preset.__doc__ = train.__doc__
    verbs |= {"train": train_with_preset, "evaluate": evaluate_run, "predict": predict}
    verbs |= {"export": export, "reproduce": reproduce, "demo": demo}
    verbs |= {"table": table, "figure": figure}
    verbs["report"] = report
    made = ("scan", "sensors", "realism", "generate", "merge", "info", "verify", "convert")
    runs = ("train", "evaluate", "predict", "export", "reproduce", "table", "figure", "report")
    order = (*made, "extract", *runs, "view", "doctor", "demo")
    return {name: verbs[name] for name in order}
