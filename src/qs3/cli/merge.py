"""``qs3 merge``: parts of a data set put together."""

from typing import Annotated

import tyro

from qs3.cli.text import notify, quoted, show


def merge(parts: Annotated[tuple[str, ...], tyro.conf.Positional], out: str) -> int:
    """Put the parts that `qs3 generate --shard i/n` made into one data set.

    Args:
        parts: Folders of all parts.
        out: Folder of the whole; run the same command again to go on after a stop.
    """
    from qs3.store.merge import merge as put_together

    report = put_together(parts, out)
    show(out)
    notify(
        f"{report.done} shards copied, {report.skipped} were there before; {report.failed} scans "
        f"had failed. Next: qs3 info --check {quoted(out)}"
    )
    return 0
