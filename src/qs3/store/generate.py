"""Scan a list of meshes into a data set: resumable, in parallel, and the same every time.

The work list (objects × scans, in fixed order) is cut into shards of a fixed number of rows. This
process gathers the rows of a shard and writes them as one file; a shard that is there is skipped.
A scan that fails is logged and absent.
"""

import warnings
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path

import pyarrow as pa

from qs3.errors import InputError
from qs3.files import claim_folder, write_json
from qs3.meshes.trees import MeshItem
from qs3.store.bars import progress_bar
from qs3.store.executors import Executor, Failure, InlineExecutor, LocalExecutor, outcomes
from qs3.store.manifest import (
    MANIFEST,
    MESHES,
    Report,
    check_same,
    claimed,
    finished_shards,
    mesh_sums,
    open_dataset,
    read_failures,
    read_mesh_sums,
    write_failures,
    write_manifest,
)
from qs3.store.plan import Plan, make_plan, resolve_renderer
from qs3.store.scan_item import GenerateSettings as GenerateSettings
from qs3.store.scan_item import scan_item as scan_item
from qs3.store.scan_item import scan_seed as scan_seed
from qs3.store.shards import CloudRow, load_shard, put_shard, table_of


def generate(
    items: Sequence[MeshItem],
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
) -> Report:
    """Scan every item into the data set at ``out``, continuing after an earlier call.

    The bytes of the shards depend on the items and the settings alone. A stop, however abrupt,
    costs the shards that are not complete.

    Args:
        items: Meshes, in the order of the rows.
        out: New or empty folder, or one that the same call began.
        settings: Settings of the data set.
        scan_one: Makes one row; a picklable function of a module. Its arguments are an item, the
            index of its scan and the settings; and, if the scene has a neighbour, other items in
            the order in which they are drawn.
        workers: Processes of this machine; 0 does the work in this one, where a crash or a hang
            of one scan ends or hangs the run.
        timeout: Seconds that one scan may take in a process; None waits for ever.
        executor: Replaces ``workers`` and ``timeout``.
        shard: ``(i, n)`` makes the shards i, i + n, i + 2n … alone, for one of n machines that
            each write into their own folder; `qs3.store.merge` puts them together.
        retry_failed: Scan again the rows that failed before.
        progress: Show a bar on the standard error stream.
    """
    index, count = shard
    if not 0 <= index < count:
        raise InputError(f"shard {index}/{count}: the first number goes from 0 to {count - 1}")
    if executor is None:
        executor = InlineExecutor() if workers == 0 else LocalExecutor(workers, timeout)
    settings = settings if scan_one is not scan_item else resolve_renderer(settings)
    plan, folder = make_plan(items, settings), Path(out)
    if not (folder / MANIFEST).is_file():
        plan.check_sizes()
    with claimed(folder):
        write_manifest(folder, plan.manifest())
        run = _Run(plan, folder, range(index, plan.shards, count), retry_failed)
        text = f"{folder.resolve().name}: scans" if progress else None
        with progress_bar(run.total, text, "scan", run.total - run.left) as bar, executor:
            calls = ((row, scan_one, *plan.arguments(row)) for row in run.rows())
            for row, outcome in outcomes(executor, calls):
                run.add(row, outcome)
                bar.set_postfix(failed=run.failed, refresh=False)
                bar.update()
    return Report(run.left - run.failed, run.total - run.left, run.failed)


def plan_data(items: Sequence[MeshItem], out: str | Path, settings: GenerateSettings) -> Plan:
    """Return the work list of `generate`; refuse what it would refuse, and write nothing."""
    plan, folder = make_plan(items, resolve_renderer(settings)), Path(out)
    claim_folder(folder, MANIFEST, make=False)
    manifest = plan.manifest()  # a scene or a range that makes no sense stops here
    if (folder / MANIFEST).is_file():
        with warnings.catch_warnings():  # of other versions: `generate` warns
            warnings.simplefilter("ignore")
            check_same(folder, open_dataset(folder), manifest)
        logged = {record["id"] for record in read_failures(folder)}
        _mesh_sums(
            plan, folder, range(plan.shards), {*finished_shards(folder, plan.shards)}, logged
        )
    return plan


def _mesh_sums(
    plan: Plan, folder: Path, shards: Iterable[int], finished: Iterable[int], failed: Container[str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return checksums of meshes, noted and now.

    A mesh that has changed since it was scanned is refused; one that failed may be mended.
    """
    items = (plan.item_of(row) for shard in shards for row in plan.rows_of(shard))
    noted = read_mesh_sums(folder)
    now = mesh_sums({item.id: item.path for item in items if item.path is not None})
    changed = {name for name, digest in now.items() if noted.get(name, digest) != digest}
    for row in (row for shard in finished for row in plan.rows_of(shard) if changed):
        if plan.item_of(row).id in changed and plan.row_id(row) not in failed:
            raise InputError(
                f"{plan.item_of(row).id}: the mesh has changed since it was scanned into "
                f"{folder}; name another folder, or put the old file back"
            )
    return noted, now


class _Run:
    """One call of `generate`: the rows to scan, and those of the shards that are not complete."""

    def __init__(self, plan: Plan, folder: Path, shards: Sequence[int], retry_failed: bool) -> None:
        self.plan, self.folder = plan, folder
        self.finished = {*finished_shards(folder, plan.shards)}
        logged = read_failures(folder)
        # A kill between log and shard leaves records of a shard that is not there.
        self.failures = {r["id"]: r for r in logged if r["shard"] in self.finished}
        if len(self.failures) < len(logged):
            write_failures(folder, self.failures.values())
        noted, now = _mesh_sums(plan, folder, shards, self.finished, self.failures)
        if not now.items() <= noted.items():
            write_json(folder / MESHES, dict(sorted((noted | now).items())))
        self.todo = {shard: self._missing(shard, retry_failed) for shard in shards}
        self.total = sum(len(plan.rows_of(shard)) for shard in shards)
        self.left = sum(map(len, self.todo.values()))
        self.failed = 0
        self._gathered: dict[int, dict[int, CloudRow | Failure]] = {}

    def _missing(self, shard: int, retry_failed: bool) -> list[int]:
        """Return the rows of a shard to scan."""
        rows = self.plan.rows_of(shard)
        if shard not in self.finished:
            return list(rows)
        if not retry_failed:
            return []
        present = {*load_shard(self.folder, shard, ["id"])["id"].to_pylist()}
        stale = present & {*self.failures}  # a kill came between the shard and the log
        for name in stale:
            del self.failures[name]
        if stale:
            write_failures(self.folder, self.failures.values())
        return [row for row in rows if self.plan.row_id(row) not in present]

    def rows(self) -> Iterable[int]:
        """Return the rows to scan, in order."""
        return (row for rows in self.todo.values() for row in rows)

    def add(self, row: int, outcome: CloudRow | Failure) -> None:
        """Take in a scan; write its shard if it was the last."""
        shard = self.plan.shard_of(row)
        gathered = self._gathered.setdefault(shard, {})
        gathered[row] = outcome
        self.failed += isinstance(outcome, Failure)
        if len(gathered) == len(self.todo[shard]):
            self._write(shard, self._gathered.pop(shard))

    def _write(self, shard: int, gathered: dict[int, CloudRow | Failure]) -> None:
        """Log the failures, write the shard, then forget earlier failures: none is ever lost."""
        scans = [row for row in gathered.values() if isinstance(row, CloudRow)]
        failures = {
            self.plan.row_id(row): self.plan.failure_record(row, outcome)
            for row, outcome in gathered.items()
            if isinstance(outcome, Failure)
        }
        if failures:
            self.failures |= failures
            write_failures(self.folder, self.failures.values())
        table = table_of(scans)
        if shard in self.finished:
            table = pa.concat_tables([load_shard(self.folder, shard), table])
        position = {name: i for i, name in enumerate(table["id"].to_pylist())}
        names = map(self.plan.row_id, self.plan.rows_of(shard))
        order = pa.array([position[name] for name in names if name in position], pa.int64())
        put_shard(self.folder, shard, table.take(order))
        mended = [scan.id for scan in scans if self.failures.pop(scan.id, None)]
        if mended:
            write_failures(self.folder, self.failures.values())
