"""What a run writes: the same bytes whoever does the work, and nothing where the input is bad."""

import dataclasses
import json
import os
import sys

import numpy as np
import pytest
import trimesh

from qs3.clouds.layouts.store import read_ragged
from qs3.errors import InputError
from qs3.meshes import MeshItem
from qs3.meshes.classes import POINTDA10
from qs3.sensor.presets import load_sensor
from qs3.sensor.stage.scene import SceneSettings
from qs3.store.generate import GenerateSettings, scan_seed
from qs3.store.info import info
from qs3.store.manifest import MANIFEST, Report, read_failures
from qs3.store.scan_item import RECIPES, neighbours_of, scan_item

SETTINGS = GenerateSettings(num_points=16, scans_per_mesh=3, rows_per_shard=4)
D435 = load_sensor("d435")
SMALL = dataclasses.replace(
    D435, rig=dataclasses.replace(D435.rig, width=424, height=240, focal=215.0)
)
"""With a quarter of the pixels."""


def items(fake, count=5, bad=()):
    return [
        fake.mesh(f"bad{i}" if i in bad else f"m{i}", POINTDA10[i], "train") for i in range(count)
    ]


def test_processes_and_none_write_the_same_bytes(fake, tmp_path):
    for workers in (0, 2):
        out = tmp_path / str(workers)
        report = fake.run(items(fake, bad=[1]), out, SETTINGS, row=fake.flaky_row, workers=workers)
        assert report == Report(done=12, skipped=0, failed=3)
    assert fake.content(tmp_path / "0") == fake.content(tmp_path / "2")
    assert read_ragged(out).ids == tuple(f"m{i}#{s}" for i in (0, 2, 3, 4) for s in range(3))
    for data in fake.content(out).values():  # nothing of the machine is inside
        assert str(tmp_path).encode() not in data
        assert os.uname().nodename.encode() not in data


def test_a_broken_object_is_logged_and_stops_nothing(fake, tmp_path):
    work = items(fake, bad=[1])
    fake.run(work, tmp_path, SETTINGS, row=fake.flaky_row)
    failures = read_failures(tmp_path)
    assert [f["id"] for f in failures] == ["bad1#0", "bad1#1", "bad1#2"]
    assert (failures[0]["error"], failures[0]["reason"]) == ("ValueError", "bad1 is broken")
    assert (info(tmp_path)["failed"], info(tmp_path)["rows"]) == (3, 12)
    whole = fake.content(tmp_path)
    (tmp_path / "shard-00000.parquet").unlink()  # holds bad1#0, which is not logged twice
    fake.run(work, tmp_path, SETTINGS, row=fake.flaky_row)
    assert fake.content(tmp_path) == whole


def test_a_warning_of_several_workers_is_logged_once(fake, tmp_path, caplog, capfd):
    fake.run(items(fake), tmp_path, SETTINGS, row=fake.warning_row, workers=2)
    assert [record.message[2:] for record in caplog.records] == [" has few points"]
    assert "few points" not in capfd.readouterr().err


def test_a_missing_package_stops_the_run_at_once(fake, tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        fake.run(items(fake), tmp_path, SETTINGS, row=fake.unavailable_row)
    assert sorted(fake.content(tmp_path)) == [MANIFEST]


def test_a_machine_that_cannot_compile_stops_the_run_and_fails_no_object(
    fake, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(InputError, match=r"^this machine cannot compile.*constraints.txt$"):
        fake.run(items(fake), tmp_path, SETTINGS, row=fake.compiling_row)
    assert sorted(fake.content(tmp_path)) == [MANIFEST]
    monkeypatch.undo()
    report = fake.run(items(fake), tmp_path, SETTINGS, row=fake.compiling_row)
    assert report == Report(done=15, skipped=0, failed=0)


def test_other_settings_or_another_work_list_are_refused(fake, tmp_path):
    fake.run(items(fake), tmp_path, SETTINGS)
    before = fake.content(tmp_path)
    for changed, name in [
        ({"sensor": "bright-room"}, "sensor.exposure"),
        ({"scans_per_mesh": 2}, "scans_per_mesh = 3, not 2"),
        ({"scene": SceneSettings("floor")}, "scene.layout = alone, not floor"),
        ({"randomise": {"light.ambient": (0.0, 0.1)}}, "randomise"),
        ({"crop": "both"}, "mask_crop"),
    ]:
        other = dataclasses.replace(SETTINGS, **changed)
        with pytest.raises(InputError, match=name):
            fake.run(items(fake), tmp_path, other)
    with pytest.raises(InputError, match="another list of meshes"):
        fake.run(items(fake)[::-1], tmp_path, SETTINGS)
    assert fake.content(tmp_path) == before


def test_bad_input_leaves_nothing_behind(fake, tmp_path):
    out = tmp_path / "out"
    for work, changed, message in [
        ([], {}, "no mesh to scan"),
        ([fake.mesh("a"), fake.mesh("a")], {}, "two meshes are called 'a'"),
        ([fake.mesh("a", "toilet")], {}, "'toilet'"),
        (items(fake), {"sensor": "kinect9"}, "no sensor 'kinect9'"),
    ]:
        with pytest.raises(InputError, match=message):
            fake.run(work, out, dataclasses.replace(SETTINGS, **changed))
    with pytest.raises(InputError, match="workers"):
        fake.run(items(fake), out, SETTINGS, workers=-1)
    assert not out.exists()
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something else"):
        fake.run(items(fake), out, SETTINGS)
    assert sorted(fake.content(out)) == ["thesis.txt"]


def test_seeds_depend_on_root_object_and_scan_alone_and_do_not_collide():
    keys = [(r, o, s) for r in (0, 1, 2**40) for o in ("a", "b", "chair/ä") for s in range(50)]
    seeds = {key: scan_seed(*key) for key in keys}
    assert len(set(seeds.values())) == len(keys)
    assert all(0 <= seed < 2**63 for seed in seeds.values())
    bits = np.array([[seed >> bit & 1 for bit in range(63)] for seed in seeds.values()])
    assert np.abs(bits.mean(axis=0) - 0.5).max() < 0.15
    # Pinned: a change would make every data set that exists irreproducible.
    assert scan_seed(0, "chair/a", 0) == 8173939628446060847


def test_neighbours_are_other_objects_drawn_evenly_from_the_scans_own_seed(fake):
    work = items(fake)
    drawn = [neighbours_of(work, 1, scan, 0)[0].id for scan in range(400)]
    counts = {name: drawn.count(name) for name in ("m0", "m2", "m3", "m4")}
    assert sum(counts.values()) == 400
    assert min(counts.values()) > 70
    assert drawn == [neighbours_of(work, 1, scan, 0)[0].id for scan in range(400)]
    assert drawn != [neighbours_of(work, 1, scan, 1)[0].id for scan in range(400)]


def test_a_scene_with_a_neighbour_hands_one_to_every_scan(fake, tmp_path):
    pairs = []

    def scan_one(item, scan, settings, neighbours):
        pairs.append((item.id, scan, neighbours[0].id))
        return fake.fake_row(item, scan, settings)

    settings = dataclasses.replace(SETTINGS, scene=SceneSettings("room+behind"))
    work = items(fake)
    with pytest.raises(InputError, match="second mesh"):
        fake.run(work[:1], tmp_path, settings, row=scan_one)
    fake.run(work, tmp_path, settings, row=scan_one)
    assert pairs == [
        (item.id, scan, neighbours_of(work, i, scan, 0)[0].id)
        for i, item in enumerate(work)
        for scan in range(3)
    ]


def test_a_neighbour_that_cannot_be_read_is_no_fault_of_the_object(tmp_path):
    (tmp_path / "broken.stl").write_text("solid broken\nfacet normal 0 0")
    shape = {"class_name": "chair", "split": "train", "path": None}
    chair, other = (MeshItem(f"chair/{seed}", shape_seed=seed, **shape) for seed in (1, 2))
    broken = MeshItem("broken", "chair", "train", tmp_path / "broken.stl", None)
    settings = GenerateSettings(
        num_points=16, sensor=SMALL, scene=SceneSettings("room+behind"), views=1
    )
    rows = [scan_item(chair, 0, settings, beside) for beside in ([broken, other], [other])]
    assert json.loads(rows[0].drawn)["neighbour"] == "chair/2"
    np.testing.assert_array_equal(rows[0].points, rows[1].points)
    with pytest.raises(InputError, match=r"broken\.stl"):
        scan_item(chair, 0, settings, [broken])


def test_a_neighbour_that_cannot_lie_or_has_no_size_is_no_fault_of_the_object(tmp_path):
    square = [[0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]]
    trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], process=False).export(tmp_path / "flat.stl")
    trimesh.creation.box((2e5, 1e5, 1e5)).export(tmp_path / "huge.stl")
    for seed, name in enumerate(("part", "other")):
        trimesh.creation.box((60, 40, 20 + seed)).export(tmp_path / f"{name}.stl")
    part, other, flat, huge = (
        MeshItem(name, name, "", tmp_path / f"{name}.stl", None)
        for name in ("part", "other", "flat", "huge")
    )
    settings = GenerateSettings(
        num_points=16, sensor=SMALL, views=1, classes=("part",), pose="resting", units="mm",
        object_size="file", distance=(0.3, 0.4), scene="table+beside",
    )  # fmt: skip
    whole = scan_item(part, 0, settings, [other])
    for bad in (flat, huge):
        row = scan_item(part, 0, settings, [bad, other])
        assert json.loads(row.drawn)["neighbour"] == "other"
        np.testing.assert_array_equal(row.points, whole.points)
        with pytest.raises(InputError, match=f"neighbour {bad.id}: "):
            scan_item(part, 0, settings, [bad])
    (tmp_path / "other.stl").write_text("solid broken")
    settings = dataclasses.replace(settings, scene=("table", "table+beside"))
    for scan in range(8):  # what the drawn scene does not need is not read
        try:
            scan_item(part, scan, settings, [other])
            break
        except InputError as error:
            assert "other.stl" in str(error)
    else:
        pytest.fail("no scene without a neighbour was scanned")


def test_a_table_in_a_room_is_drawn_among_other_scenes():
    chair = MeshItem("chair/1", "chair", "train", None, shape_seed=1)
    settings = GenerateSettings(num_points=16, sensor=SMALL, views=1, scene=("room+table", "wall"))
    layouts = set()
    for scan in range(8):
        drawn = json.loads(scan_item(chair, scan, settings).drawn)
        layouts.add(drawn["scene"])
        assert "neighbour" not in drawn
        if len(layouts) == 2:
            break
    assert layouts == {"room+table", "wall"}


def test_the_recipe_for_parts_repeats_no_point():
    bolt = MeshItem("bolt/1", "bolt", "train", None, shape_seed=1)
    settings = dataclasses.replace(
        RECIPES["parts"], classes=("bolt",), scene="table", randomise=None
    )
    row = scan_item(bolt, 0, settings)
    assert 100 < len(row.points) == len(row.clean) < settings.num_points
    assert len(np.unique(row.points, axis=0)) == len(row.points)
