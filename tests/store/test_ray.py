"""The same data set from a Ray cluster as from this machine, also when a node is lost."""

import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from qs3.errors import InputError, MissingExtraError
from qs3.store.executors import guarded
from qs3.store.executors.ray_cluster import RayExecutor
from qs3.store.failures import read_failures
from qs3.store.generate import GenerateReport

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")

ROWS = 60


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Three nodes of two cores on this machine; the first is the head."""
    ray = pytest.importorskip("ray", exc_type=ImportError, reason="needs the extra ray")
    from ray.cluster_utils import Cluster

    # Its workers import the fakes by name.
    places = [str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(places))
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    small = {"num_cpus": 2, "object_store_memory": 80 * 2**20}
    made = Cluster(initialize_head=True, head_node_args=small | {"include_dashboard": False})
    made.add_node(**small)
    made.add_node(**small)
    made.wait_for_nodes()
    ray.init(address=made.address, log_to_driver=False, logging_level=logging.ERROR)
    yield made
    ray.shutdown()
    made.shutdown()


def whole(fake, folder: Path) -> dict[str, bytes]:
    fake.run(fake.work(ROWS, bad=(7,)), folder, row=fake.flaky_row)
    return fake.content(folder)


@pytest.mark.slow
def test_a_node_killed_half_way_changes_no_byte(fake, tmp_path, cluster):
    out = tmp_path / "out"
    nodes = sorted(cluster.list_all_nodes(), key=lambda node: node.head)
    seen = []

    def kill_one() -> None:
        while len(list(out.glob("shard-*.parquet"))) < ROWS // 8:
            time.sleep(0.05)
        seen.append(len(list(out.glob("shard-*.parquet"))))
        cluster.remove_node(nodes[0], allow_graceful=False)

    killer = threading.Thread(target=kill_one)
    killer.start()
    work = fake.work(ROWS, bad=(7,))
    report = fake.run(work, out, row=fake.slow_flaky_row, executor=RayExecutor())
    killer.join()
    assert ROWS // 8 <= seen[0] < ROWS // 4 - 1, "the node was not killed half-way"
    assert len(cluster.list_all_nodes()) == 2
    assert report == GenerateReport(done=ROWS - 1, skipped=0, failed=1)
    assert fake.content(out) == whole(fake, tmp_path / "whole")


@pytest.mark.slow
def test_on_a_cluster_too_what_hangs_or_crashes_fails_alone(fake, tmp_path, cluster):
    for name, kind in (("hangs", "Timeout"), ("exits", "ProcessDied")):
        work = fake.work(6, (2,), name)
        executor = RayExecutor(timeout=12.0 if kind == "Timeout" else None, retries=1)
        report = fake.run(work, tmp_path / name, row=fake.deadly_row, executor=executor)
        assert report == GenerateReport(done=5, skipped=0, failed=1)
        assert [record["error"] for record in read_failures(tmp_path / name)] == [kind]


@pytest.mark.slow
def test_a_lost_raylet_is_no_failure_of_a_scan(fake, tmp_path, cluster):
    out = tmp_path / "out"

    def kill_head() -> None:
        while not list(out.glob("shard-*.parquet")):
            time.sleep(0.05)
        for entry in cluster.head_node.all_processes["raylet"]:
            entry.process.kill()

    killer = threading.Thread(target=kill_head)
    killer.start()
    work = fake.work(ROWS, bad=(7,))
    with pytest.raises(InputError, match="run the same command again, nothing is lost") as caught:
        fake.run(work, out, row=fake.slow_flaky_row, executor=RayExecutor())
    killer.join()
    assert "\n" not in str(caught.value)
    assert {record["object"] for record in read_failures(out)} <= {"bad7"}
    fake.run(work, out, row=fake.flaky_row)
    assert fake.content(out) == whole(fake, tmp_path / "whole")


class RayError(Exception):
    pass


class TaskError(RayError):
    cause = ModuleNotFoundError("No module named 'qs3'")


class FakeRay:
    """Does each task when it is waited for, and tells what it is told to of every third."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=TaskError)

    def __init__(self, fault: Exception) -> None:
        self.fault, self.count = fault, 0

    def is_initialized(self) -> bool:
        return True

    def cluster_resources(self) -> dict[str, int]:
        return {"CPU": 1}

    def remote(self, **_: Any) -> Callable[..., Any]:
        def task(function: Callable[..., Any]) -> SimpleNamespace:
            return SimpleNamespace(remote=lambda *given: partial(function, *given))

        return task

    def wait(self, calls: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return calls[:num_returns], calls[num_returns:]

    def get(self, call: Callable[[], Any]) -> Any:
        self.count += 1
        if self.count % 3 == 0:
            raise self.fault
        return call()

    def cancel(self, call: Any, force: bool) -> None:
        raise self.fault


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (RayError("the raylet died\nand more"), "lost a call 4 times or .*RayError: the raylet d"),
        (TaskError(), "on the cluster: No module named 'qs3'"),
    ],
)
def test_what_the_cluster_loses_is_no_failure_and_is_made_on_the_next_run(
    fake, tmp_path, monkeypatch, fault, message
):
    def in_this_process(timeout, folder, function, arguments):
        return guarded(function, *arguments)

    monkeypatch.setitem(sys.modules, "ray", FakeRay(fault))
    monkeypatch.setattr("qs3.store.executors.ray_cluster._call", in_this_process)
    work, out = fake.work(12, bad=(1,)), tmp_path / "out"
    for _ in range(20):
        try:
            fake.run(work, out, row=fake.flaky_row, executor=RayExecutor())
        except InputError as error:
            assert re.search(message, str(error)) and "\n" not in str(error)
            assert {record["object"] for record in read_failures(out)} <= {"bad1"}
        else:
            break
    fake.run(work, tmp_path / "whole", row=fake.flaky_row)
    assert fake.content(out) == fake.content(tmp_path / "whole")


def test_gpus_that_are_not_there_are_refused(fake, tmp_path, cluster):
    with pytest.raises(InputError, match="no GPU at this moment"):
        fake.run([fake.FakeItem("m")], tmp_path / "out", executor=RayExecutor(gpus=0.25))


def test_an_address_without_a_cluster_is_told(fake, tmp_path):
    pytest.importorskip("ray", exc_type=ImportError)
    with pytest.raises(InputError, match="no Ray cluster answers there"):
        fake.run([fake.FakeItem("m")], tmp_path / "out", executor=RayExecutor("auto"))


@pytest.mark.parametrize("how", [{"timeout": 0.0}, {"gpus": -1.0}, {"retries": -1}])
def test_numbers_out_of_range_are_refused(how):
    with pytest.raises(InputError):
        RayExecutor(**how)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"\[ray\]"):
        RayExecutor()
