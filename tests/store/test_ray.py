"""The same data set from a Ray cluster as from this machine, also when a node is lost."""

import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from qs3.errors import InputError, MissingExtraError
from qs3.store.executors.ray_cluster import RayExecutor
from qs3.store.manifest import Report, read_failures

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
    ray_cluster = Cluster(initialize_head=True, head_node_args=small | {"include_dashboard": False})
    ray_cluster.add_node(**small)
    ray_cluster.add_node(**small)
    ray_cluster.wait_for_nodes()
    ray.init(address=ray_cluster.address, log_to_driver=False, logging_level=logging.ERROR)
    yield ray_cluster
    ray.shutdown()
    ray_cluster.shutdown()


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
    assert report == Report(done=ROWS - 1, skipped=0, failed=1)
    assert fake.content(out) == whole(fake, tmp_path / "whole")


@pytest.mark.slow
def test_on_a_cluster_too_what_hangs_or_crashes_fails_alone(fake, tmp_path, cluster):
    for name, kind in (("hangs", "Timeout"), ("exits", "ProcessDied")):
        work = fake.work(6, (2,), name)
        executor = RayExecutor(timeout=45.0 if kind == "Timeout" else None)
        report = fake.run(work, tmp_path / name, row=fake.deadly_row, executor=executor)
        assert report == Report(done=5, skipped=0, failed=1)
        assert [record["error"] for record in read_failures(tmp_path / name)] == [kind]


@pytest.mark.slow
def test_gpus_that_are_not_there_are_refused(fake, tmp_path, cluster):
    with pytest.raises(InputError, match="the cluster has no GPU"):
        fake.run([fake.mesh("m")], tmp_path / "out", executor=RayExecutor(gpus=0.25))


def test_an_address_without_a_cluster_is_told(fake, tmp_path):
    pytest.importorskip("ray", exc_type=ImportError)
    with pytest.raises(InputError, match="no Ray cluster answers there"):
        fake.run([fake.mesh("m")], tmp_path / "out", executor=RayExecutor("auto"))


@pytest.mark.parametrize("options", [{"timeout": 0.0}, {"gpus": -1.0}])
def test_numbers_out_of_range_are_refused(options):
    with pytest.raises(InputError):
        RayExecutor(**options)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"\[ray\]"):
        RayExecutor()
