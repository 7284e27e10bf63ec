import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.layouts.contents import MANIFEST, read_store
from qs3.meshes.classes import POINTDA10
from qs3.store.failures import FAILURES, read_failures
from qs3.store.generate import (
    GenerateReport,
    GenerateSettings,
    scan_seed,
)
from qs3.store.generate import generate as generate_anywhere
from qs3.store.info import info
from qs3.store.manifest import SUMS
from qs3.store.parts import part_folder
from qs3.store.scan_item import neighbour_of


def generate(*arguments, workers=0, **settings):
    """In this process where nothing else is said: these scans cost nothing."""
    return generate_anywhere(*arguments, workers=workers, **settings)


SETTINGS = GenerateSettings(num_points=16, scans_per_mesh=3, rows_per_shard=4)


def items(fake, count=5, bad=()):
    return [
        fake.FakeItem(f"bad{i}" if i in bad else f"m{i}", POINTDA10[i], "train")
        for i in range(count)
    ]


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, whatever its depth."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_one_and_two_workers_write_the_same_bytes(fake, tmp_path):
    for workers in (1, 2):
        report = generate(
            items(fake, bad=[1]),
            tmp_path / str(workers),
            SETTINGS,
            scan_one=fake.flaky_row,
            workers=workers,
            progress=False,
        )
        assert report == GenerateReport(done=12, skipped=0, failed=3)
    assert content(tmp_path / "1") == content(tmp_path / "2")
    ids = read_store(tmp_path / "1").ids
    assert ids == tuple(f"m{i}#{s}" for i in (0, 2, 3, 4) for s in range(3))


def test_nothing_of_the_machine_is_inside(fake, tmp_path):
    generate(items(fake), tmp_path / "o", SETTINGS, scan_one=fake.fake_row, progress=False)
    for data in content(tmp_path / "o").values():
        assert str(tmp_path).encode() not in data
        assert os.uname().nodename.encode() not in data


def test_a_broken_object_is_logged_and_stops_nothing(fake, tmp_path):
    generate(items(fake, bad=[1]), tmp_path, SETTINGS, scan_one=fake.flaky_row, progress=False)
    failures = read_failures(tmp_path)
    assert [f["id"] for f in failures] == ["bad1#0", "bad1#1", "bad1#2"]
    assert failures[0]["reason"] == "bad1 is broken"
    assert failures[0]["error"] == "ValueError"
    assert info(tmp_path)["failed"] == 3
    assert info(tmp_path)["rows"] == 12


def test_a_worker_that_dies_takes_only_its_object_along(fake, tmp_path):
    report = generate(
        items(fake, bad=[2]),
        tmp_path / "dead",
        SETTINGS,
        scan_one=fake.deadly_row,
        workers=2,
        progress=False,
    )
    assert report == GenerateReport(done=12, skipped=0, failed=3)
    assert {f["error"] for f in read_failures(tmp_path / "dead")} == {"ProcessDied"}
    generate(
        items(fake, bad=[2]), tmp_path / "raise", SETTINGS, scan_one=fake.flaky_row, progress=False
    )
    names = [name for name in content(tmp_path / "raise") if name != FAILURES]
    assert all(content(tmp_path / "raise")[n] == content(tmp_path / "dead")[n] for n in names)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_missing_package_stops_the_run_at_once(fake, tmp_path, workers):
    with pytest.raises(InputError, match="nowhere"):
        generate(
            items(fake),
            tmp_path,
            SETTINGS,
            scan_one=fake.unavailable_row,
            workers=workers,
            progress=False,
        )
    assert sorted(content(tmp_path)) == [MANIFEST]


def test_a_run_that_was_stopped_goes_on_and_ends_the_same(fake, tmp_path):
    for name in ("whole", "resumed"):
        folder = tmp_path / name
        if name == "resumed":
            with pytest.raises(KeyboardInterrupt):
                generate(
                    items(fake), folder, SETTINGS, scan_one=fake.Interrupting(6), progress=False
                )
            parts = [".parts/00001/000000.parquet", ".parts/00001/000001.parquet"]
            whole = [SUMS, MANIFEST, "shard-00000.parquet"]
            assert sorted(content(folder)) == sorted([*parts, *whole])
            stamp = (folder / "shard-00000.parquet").stat().st_mtime_ns
        report = generate(items(fake), folder, SETTINGS, scan_one=fake.fake_row, progress=False)
    assert report == GenerateReport(done=9, skipped=6, failed=0)
    assert (folder / "shard-00000.parquet").stat().st_mtime_ns == stamp
    assert content(tmp_path / "whole") == content(tmp_path / "resumed")
    again = generate(items(fake), folder, SETTINGS, scan_one=fake.fake_row, progress=False)
    assert again == GenerateReport(done=0, skipped=15, failed=0)


def test_failures_of_a_shard_that_is_scanned_again_are_not_doubled(fake, tmp_path):
    work = items(fake, bad=[1])
    generate(work, tmp_path, SETTINGS, scan_one=fake.flaky_row, progress=False)
    whole = content(tmp_path)
    (tmp_path / "shard-00000.parquet").unlink()  # holds bad1#0
    generate(work, tmp_path, SETTINGS, scan_one=fake.flaky_row, progress=False)
    assert {f["id"] for f in read_failures(tmp_path)} == {"bad1#0", "bad1#1", "bad1#2"}
    assert len(read_failures(tmp_path)) == 3
    shards = [name for name in whole if name.endswith(".parquet")]
    assert all(whole[name] == content(tmp_path)[name] for name in shards)


def test_other_settings_or_another_work_list_are_refused(fake, tmp_path):
    generate(items(fake), tmp_path, SETTINGS, scan_one=fake.fake_row, progress=False)
    before = content(tmp_path)
    for changed, name in [
        ({"seed": 4}, "seed = 0, not 4"),
        ({"sensor": "bright-room"}, "sensor.exposure"),
        ({"scans_per_mesh": 2}, "scans_per_mesh = 3, not 2"),
    ]:
        other = dataclasses.replace(SETTINGS, **changed)
        with pytest.raises(InputError, match=name):
            generate(items(fake), tmp_path, other, scan_one=fake.fake_row, progress=False)
    with pytest.raises(InputError, match="work_list"):
        generate(items(fake)[::-1], tmp_path, SETTINGS, scan_one=fake.fake_row, progress=False)
    assert content(tmp_path) == before


def test_bad_input_leaves_nothing_behind(fake, tmp_path):
    out = tmp_path / "out"
    cases = [
        ([], "no mesh to scan"),
        ([fake.FakeItem("a"), fake.FakeItem("a")], "two meshes are called 'a'"),
        ([fake.FakeItem("a", "toilet")], "'toilet'"),
    ]
    for work, message in cases:
        with pytest.raises(InputError, match=message):
            generate(work, out, SETTINGS, scan_one=fake.fake_row, progress=False)
    with pytest.raises(InputError, match="workers"):
        generate(items(fake), out, SETTINGS, scan_one=fake.fake_row, workers=-1, progress=False)
    with pytest.raises(InputError, match="no sensor 'kinect9'"):
        bad = dataclasses.replace(SETTINGS, sensor="kinect9")
        generate(items(fake), out, bad, scan_one=fake.fake_row, progress=False)
    assert not out.exists()
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        generate(items(fake), out, SETTINGS, scan_one=fake.fake_row, progress=False)
    assert sorted(content(out)) == ["thesis.txt"]


@pytest.mark.parametrize("name", ["scans_per_mesh", "views", "num_points", "rows_per_shard"])
def test_settings_are_checked(name):
    with pytest.raises(InputError, match=name):
        GenerateSettings(**{name: 0})
    with pytest.raises(InputError, match="seed"):
        GenerateSettings(seed=-1)


def test_a_pattern_picture_is_recorded_by_name_and_content(tmp_path):
    from qs3.sensor.presets import get_sensor

    picture = tmp_path / "dots.png"
    picture.write_bytes(b"dots")
    qs3 = get_sensor("paper")
    pattern = dataclasses.replace(qs3.pattern, image=str(picture))
    settings = GenerateSettings(sensor=dataclasses.replace(qs3, pattern=pattern))
    recorded = json.dumps(settings.as_dict())
    assert "dots.png" in recorded
    assert str(tmp_path) not in recorded


def test_seeds_depend_on_root_object_and_scan_alone_and_do_not_collide():
    keys = [(r, o, s) for r in (0, 1, 2**40) for o in ("a", "b", "chair/ä") for s in range(50)]
    seeds = {key: scan_seed(*key) for key in keys}
    assert len(set(seeds.values())) == len(keys)
    assert all(0 <= seed < 2**63 for seed in seeds.values())
    bits = np.array([[seed >> bit & 1 for bit in range(63)] for seed in seeds.values()])
    assert np.abs(bits.mean(axis=0) - 0.5).max() < 0.15
    # Pinned: a change would make every data set that exists irreproducible.
    assert scan_seed(0, "chair/a", 0) == PINNED


def test_neighbours_are_other_objects_drawn_evenly_from_the_scans_own_seed(fake):
    work = items(fake)
    drawn = [neighbour_of(work[1], scan, work, 0).id for scan in range(400)]
    counts = {name: drawn.count(name) for name in ("m0", "m2", "m3", "m4")}
    assert sum(counts.values()) == 400
    assert min(counts.values()) > 70
    assert drawn == [neighbour_of(work[1], scan, work, 0).id for scan in range(400)]
    assert drawn != [neighbour_of(work[1], scan, work, 1).id for scan in range(400)]
    with pytest.raises(InputError, match="second mesh"):
        neighbour_of(work[1], 0, work[1:2], 0)


def test_a_scene_with_a_neighbour_hands_one_to_every_scan(fake, tmp_path):
    from qs3.sensor.scene import SceneSettings

    seen = []

    def scan_one(item, scan, settings, neighbour):
        seen.append((item.id, scan, neighbour.id))
        return fake.fake_row(item, scan, settings)

    settings = dataclasses.replace(SETTINGS, scene=SceneSettings("room+behind"))
    work = items(fake)
    generate(work, tmp_path, settings, scan_one=scan_one, progress=False)
    assert seen == [
        (item.id, scan, neighbour_of(item, scan, work, 0).id) for item in work for scan in range(3)
    ]


def test_scene_and_ranges_belong_to_the_record(fake, tmp_path):
    generate(items(fake), tmp_path, SETTINGS, scan_one=fake.fake_row, progress=False)
    from qs3.sensor.scene import SceneSettings

    for changed, name in [
        ({"scene": SceneSettings("floor")}, "scene.layout = alone, not floor"),
        ({"randomise": {"light.ambient": (0.0, 0.1)}}, "randomise"),
        ({"crop": "both"}, "mask_crop"),
        ({"box_margin": 0.1}, "box_margin"),
    ]:
        other = dataclasses.replace(SETTINGS, **changed)
        with pytest.raises(InputError, match=name):
            generate(items(fake), tmp_path, other, scan_one=fake.fake_row, progress=False)
    with pytest.raises(InputError, match=r"light\.ambient"):
        generate(
            items(fake),
            tmp_path / "new",
            dataclasses.replace(SETTINGS, randomise={"light.ambiant": (0.0, 0.1)}),
            scan_one=fake.fake_row,
            progress=False,
        )
    assert not (tmp_path / "new").exists()


PINNED = 8173939628446060847


SCRIPT = """
import signal, sys, time
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from qs3_fake_scan import FakeItem, slow_row
from qs3.store.generate import GenerateSettings, generate
if __name__ == "__main__":
    # A job started in the background inherits that Ctrl-C is ignored; this one is to act on it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    settings = GenerateSettings(num_points=16, rows_per_shard=2)
    work = [FakeItem(f"m{i}") for i in range(400)]
    try:
        generate(work, Path(sys.argv[2]), settings, scan_one=slow_row, workers=2, progress=False)
    except KeyboardInterrupt:
        sys.exit(130)
"""


def test_interrupt_of_the_whole_group_keeps_finished_shards(fake, tmp_path):
    script, out = tmp_path / "script.py", tmp_path / "out"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), str(Path(__file__).parent), str(out)]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60
    shard, parts = out / "shard-00000.parquet", out / part_folder(0)
    # The run knows of a shard when it takes the parts away, which is a moment after it is written.
    while (parts.exists() or not shard.exists()) and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert b"Traceback" not in errors
    left = content(out)
    assert {MANIFEST, SUMS} <= set(left)
    assert all(name.endswith(".parquet") for name in set(left) - {MANIFEST, SUMS})
    counts = info(out)
    assert counts["rows"] == 2 * counts["shards"] < 400
