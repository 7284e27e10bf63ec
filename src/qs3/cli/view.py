"""``qs3 view``: step through a data set, a run's answers or one cloud."""

import contextlib
from typing import Annotated

import tyro

from qs3.cli.text import notify, show


def view(
    what: Annotated[str, tyro.conf.Positional],
    data: str | None = None,
    split: str | None = None,
    port: int = 8080,
) -> int:
    """Step through a data set, a run's answers or one cloud in a browser, until Ctrl-C.

    Args:
        what: Data set of any layout that qs3 train reads, run of qs3 train, or file of points.
        data: With a run: the clouds to predict; their labels are shown, not used.
        split: Part of the data, such as test; all of it by default.
        port: Port of 127.0.0.1 to listen on; the next free one if it is in use.
    """
    from qs3.checks import check_numbers
    from qs3.report.view import open_items, serve, wait

    check_numbers("--port", port, 0, 65535)
    items = open_items(what, data, split)
    notify(*(f"qs3: {fault}" for fault in items.faults))
    with contextlib.suppress(KeyboardInterrupt), serve(items, port) as (address, _):
        show(address)
        notify("Open it in a browser; Ctrl-C ends it.")
        wait()
    return 2 if items.faults else 0
