"""Scan a list of meshes into a data set: resumable, in parallel, and the same every time.

The work list (objects × scans, in fixed order) is cut into shards of a fixed number of rows. The
process that makes a scan writes it down at once (`qs3.store.parts`); a shard is put together
when all its scans are there. An object that fails is logged and absent.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from qs3.errors import InputError
from qs3.store.executors import Executor, InlineExecutor, LocalExecutor
from qs3.store.folder import open_folder
from qs3.store.generation import GenerateReport as GenerateReport
from qs3.store.generation import Generation
from qs3.store.manifest import MANIFEST, write_manifest
from qs3.store.plan import make_plan, resolve_renderer
from qs3.store.scan_item import GenerateSettings as GenerateSettings
from qs3.store.scan_item import Item as Item
from qs3.store.scan_item import scan_item as scan_item
from qs3.store.scan_item import scan_seed as scan_seed
from qs3.store.shards import CloudRow


def generate(
    items: Sequence[Item],
    out: str | Path,
    settings: GenerateSettings,
    *,
    scan_one: Callable[..., CloudRow] = scan_item,
    workers: int = 1,
    timeout: float | None = None,
    executor: Executor | None = None,
    shard: tuple[int, int] = (0, 1),
    retry_failed: bool = False,
    progress: bool = True,
) -> GenerateReport:
    """Scan every item into the data set at ``out``, going on where an earlier call stopped.

    The bytes of the shards depend on the items and the settings alone. Ctrl-C lets the scans
    that are under way end, keeps them, and raises ``KeyboardInterrupt``.

    Args:
        items: Meshes, in the order of the rows.
        out: New or empty folder, or one that the same call began; any address that fsspec knows.
        settings: Settings of the data set.
        scan_one: Makes one row; a picklable function of a module. It is handed an item, the index
            of its scan and the settings, and a second item where the scene has a neighbour.
        workers: Processes of this machine; 0 does the work in this one, where a crash or a hang
            of one scan ends or hangs the run.
        timeout: Seconds that one scan may take in a process; None waits for ever.
        executor: Where the work is done, in place of ``workers`` and ``timeout``.
        shard: ``(i, n)`` makes the shards i, i + n, i + 2n … alone, for one of n machines that
            each write into a folder of their own; `qs3.store.merge` puts them together.
        retry_failed: Scan again what failed before.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where the list is empty or has equal ids, a class is unknown, the folder holds
            something else or a data set of other settings, another process writes into it, or a
            fault lies with the machine (a missing package, a full disk) and not with an object.
    """
    index, count = shard
    if not 0 <= index < count:
        raise InputError(f"shard {index}/{count}: the first number goes from 0 to {count - 1}")
    if executor is None:
        executor = InlineExecutor() if workers == 0 else LocalExecutor(workers, timeout)
    settings = settings if scan_one is not scan_item else resolve_renderer(settings)
    plan = make_plan(items, settings)
    manifest = plan.manifest()
    folder = open_folder(out)
    folder.claim(MANIFEST)
    mine = range(index, plan.shards, count)
    with folder.locked():
        try:
            write_manifest(folder, manifest)
            run = Generation(plan, folder, executor, scan_one)
            run.look()
            run.check_meshes(mine)
            run.prepare(mine, retry_failed)
            return run.work(f"{folder.name}: scans" if progress else None)
        except OSError as error:
            raise InputError(
                f"{folder}: cannot be written to ({error.strerror or error}); mend that and run "
                "the same command again, nothing is lost"
            ) from error
