"""``qs3 scan`` and ``qs3 generate`` with a scene, randomisation and frames."""

import dataclasses
import json

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from matplotlib.figure import Figure

from qs3.errors import TOLD, InputError
from qs3.store.plan import make_plan
from qs3.store.scan_item import RECIPES


@pytest.fixture(autouse=True)
def empty_sheet(monkeypatch):
    """In place of the pictures of a scan, which take long to draw."""
    monkeypatch.setattr("qs3.report.montage.montage", lambda *_: Figure(figsize=(1, 1)))


@pytest.fixture
def metric(quick, tmp_path):
    """As ``quick``, with a camera in metres that has a sixteenth of the pixels of a D435."""
    path = tmp_path / "metric.toml"
    path.write_text(
        'base = "d435"\nrig = { width = 212, height = 120, focal = 107.5 }\n'
        "pattern = { columns = 135, rows = 84 }\n"
    )
    return (*quick, "--sensor", path)


def written(out):
    """Rows of a data set of one shard, their draws, and the settings."""
    rows = pq.read_table(out / "shard-00000.parquet").to_pylist()
    settings = json.loads((out / "dataset.json").read_text())["settings"]
    return rows, [json.loads(row["drawn"]) for row in rows], settings


def test_scan_writes_frames_of_a_scene_and_records_it(typed, small, tmp_path):
    out = tmp_path / "scan"
    done = typed("scan", "chair", "--out", out, "--seed", 2, "--scene", "floor+beside",
                 "--neighbour", "table", "--crop", "mask", "--frames",
                 "--randomise", "light.ambient=0.02:0.08", "material=diffuse,dark",
                 "--num-points", 64, "--object-size", 0.5, *small)  # fmt: skip
    assert str(out / "frames") in done.stdout
    record = json.loads((out / "scan.json").read_text())
    assert record["settings"]["scene"]["layout"] == "floor+beside"
    assert record["settings"]["mask_crop"] is True
    assert record["settings"]["box_crop"] is False
    assert record["mesh"]["neighbour"]["name"] == "table"
    assert 0.02 <= record["drawn"]["light.ambient"] <= 0.08
    assert record["drawn"]["material"] in ("diffuse", "dark")
    assert record["sensor"]["light"]["ambient"] == record["drawn"]["light.ambient"]
    assert record["sensor"]["object_size"] == 0.5
    cloud = trimesh.load(out / "clean.ply")
    assert np.ptp(np.asarray(cloud.vertices), axis=0).max() <= 0.5 + 1e-6
    scene = out / "frames" / "000000"
    assert {path.name for path in scene.glob("*.json")} == {
        "scene_camera.json", "scene_gt.json", "scene_gt_info.json"
    }  # fmt: skip
    mask = cv2.imread(str(scene / "mask_visib" / "000000_000000.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (270, 270)
    assert (mask > 0).sum() == record["views"][0]["object_pixels"]
    typed("scan", "chair", "--out", out, "--num-points", 64, *small)
    assert not (out / "frames").exists()

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    (out / "frames").symlink_to(tmp_path / "mine")
    before = sorted(tmp_path.glob("mine/**/*"))
    assert "frames: is a link" in typed.refuses("scan", "chair", "--out", out, "--frames", *small)
    assert sorted(tmp_path.glob("mine/**/*")) == before


def test_generate_draws_neighbours_and_settings_and_records_them(typed, small, tmp_path):
    common = ("generate", "--meshes", "shapes", "--classes", "chair", "lamp",
              "--per-class", 1, "--scene", "room+beside", "--randomise", "default",
              "--num-points", 64, "--crop", "box", "--box-margin", 0.05, *small)  # fmt: skip
    typed(*common, "--out", tmp_path / "out", "--workers", 0)
    rows, drawn, settings = written(tmp_path / "out")
    ids = {row["object"] for row in rows}
    for row, values in zip(rows, drawn, strict=True):
        assert values["neighbour"] in ids - {row["object"]}
        assert set(values) == {
            "neighbour", "material", "light.ambient", "light.projector", "exposure.gain"
        }  # fmt: skip
    assert len({values["light.ambient"] for values in drawn}) == 2
    assert settings["scene"]["layout"] == "room+beside"
    assert settings["box_margin"] == 0.05
    assert settings["randomise"]["light.projector"][2] == "log"


@pytest.mark.parametrize(
    ("folder", "called"),
    [("dresser", "storage"), ("gizmo", "cabinet")],  # the size of its own name, that of its new one
)
def test_real_sizes_are_known_by_either_name_of_a_mapped_class(
    typed, metric, tmp_path, folder, called
):
    meshes = tmp_path / "meshes" / folder
    meshes.mkdir(parents=True)
    trimesh.creation.box((40.0, 40.0, 40.0)).export(meshes / "a.ply")
    (tmp_path / "map.toml").write_text(f'{folder} = "{called}"')
    typed("generate", "--meshes", meshes.parent, "--map", tmp_path / "map.toml",
          "--object-size", "class", "--scans-per-mesh", 1, "--num-points", 64, "--workers", 0,
          "--out", tmp_path / "out", *metric)  # fmt: skip
    (row,) = pq.read_table(tmp_path / "out" / "shard-00000.parquet").to_pylist()
    assert row["class_name"] == called
    assert 0.45 <= json.loads(row["drawn"])["object_size"] <= 2.2  # CLASS_SIZES["cabinet"]


def test_scan_takes_the_size_of_a_file_and_tells_its_guess(typed, metric, tmp_path, caplog):
    TOLD.clear()
    mesh = tmp_path / "part.stl"
    trimesh.creation.box((400.0, 300.0, 200.0)).export(mesh)
    options = ("--object-size", "file", "--num-points", 64, *metric)
    facts = ("--up", "y", "--class-name", "pump")
    done = typed("scan", mesh, "--out", tmp_path / "guessed", *facts, *options)
    assert "does not name its unit: taken for mm" in caplog.text
    record = json.loads((tmp_path / "guessed" / "scan.json").read_text())
    assert record["drawn"] == {"object_size": 0.4, "units": "mm (guessed)"}
    assert record["settings"]["object_size"] == "file"
    assert (record["mesh"]["up"], record["mesh"]["class_name"]) == ("y", "pump")
    assert record["frames"] is False
    assert {"numba", "llvmlite"} < set(record["versions"])
    mine = tmp_path / "guessed" / "mine.png"
    mine.write_bytes(b"")
    again = typed("scan", mesh, "--out", tmp_path / "guessed", *facts, *options)
    assert "guessed: the scan that was there is replaced" in again.stderr
    assert "is replaced" not in done.stderr
    assert mine.is_file()
    assert "400 m" in typed.refuses("scan", mesh, "--out", tmp_path / "x", "--units", "m", *options)


@pytest.fixture
def planned(monkeypatch):
    """The plans that ``qs3 generate`` was stopped at."""
    plans = []

    def stop(items, settings):
        plans.append(make_plan(items, settings))
        raise KeyboardInterrupt

    for module in ("generate", "plan"):  # the first imports it from the other
        monkeypatch.setattr(f"qs3.store.{module}.make_plan", stop)
    return plans


def test_the_recipe_is_settings_and_what_is_given_beside_it_wins(typed, planned, tmp_path):
    words = ("generate", "--recipe", "rooms", "--out", tmp_path / "out", "--dry-run",
             "--variant", "scalar_rgb")  # fmt: skip
    typed(*words, code=130)
    help_text = typed(*words, "--help").stdout
    assert "kinect-v1" in help_text.split("--sensor")[1].split("--image-noise")[0]
    chosen = ("--sensor", "d435", "--views", 1, "--per-class", 2, "--scans-per-mesh", 3)
    typed(*words, *chosen, "--object-size", "file", code=130)
    whole, changed = planned
    recipe = dataclasses.replace(RECIPES["rooms"], meshes="shapes", variant="scalar_rgb")
    different = ("sensor", "renderer", "variant")  # made by now
    assert whole.settings.renderer.variant == "scalar_rgb"
    for name in {field.name for field in dataclasses.fields(recipe)} - {*different}:
        assert getattr(whole.settings, name) == getattr(recipe, name)
    assert [one.name for one in whole.settings.sensor] == list(RECIPES["rooms"].sensor)
    assert (len(whole.items), whole.rows) == (600, 1200)
    assert (changed.settings.sensor.name, changed.settings.views) == ("d435", 1)
    assert (len(changed.items), changed.rows) == (20, 60)
    assert changed.settings.real_size == "file"
    assert list(changed.settings.randomise) == ["rooms"]


def test_the_recipe_for_parts_takes_a_folder_and_ranges_in_one_word(typed, planned, tmp_path):
    for name in ("bolt", "nut"):
        (tmp_path / name).mkdir()
        trimesh.creation.box((60, 40, 20)).export(tmp_path / name / "a.stl")
    words = ("generate", "--recipe", "parts", "--dry-run", "--variant", "scalar_rgb", "--meshes")
    typed(*words, tmp_path, "--units", "mm", "--distance", "0.4:0.5", "--scene", "table", code=130)
    (plan,) = planned
    settings = plan.settings
    assert (settings.distance, settings.elevation) == ((0.4, 0.5), (35.0, 80.0))
    assert (settings.scene, settings.units, settings.pose) == ("table", "mm", "resting")
    assert settings.sensor.placement.radius == (0.4, 0.5)
    assert (plan.rows, settings.needs_neighbour) == (20, False)
    assert RECIPES["parts"].needs_neighbour
    assert "LOW:HIGH" in typed.refuses(*words, tmp_path, "--distance", "0.4")

    scans = tmp_path / "scans"
    scans.mkdir()
    np.savetxt(scans / "a.xyz", np.random.default_rng(0).random((200, 3)) * 0.1)
    (scans / "objects.csv").write_text("distance,elevation\n0.5,60\n")
    done = typed(*words, tmp_path, "--like", scans, "--distance", "0.4:0.6", code=130)
    assert "distance 0.5 to 0.5 m, elevation 60 to 60°" in done.stderr
    like = planned[-1].settings
    assert (like.distance, like.elevation, like.num_points) == ((0.4, 0.6), (60, 60), 200)
    assert like.like in done.stderr

    (scans / "objects.csv").write_text("file,distance,elevation\na.xyz,0.5,60\n")
    grid = np.mgrid[-10:11, -10:11].reshape(2, -1) * (2 * 0.5 / 920)  # each second pixel of a D415
    np.savetxt(scans / "a.xyz", np.column_stack([*grid, np.full(441, 0.01)]))
    for sensor in ("d415", "d415,d435"):
        typed(*words, tmp_path, "--like", scans, "--sensor", sensor, code=130)
        assert planned[-1].settings.stride == 2


def test_the_recipe_mixes_sensors_alike_with_any_number_of_workers(typed, tmp_path):
    from qs3.clouds.load import load_clouds

    rigs = {"d435": (212, 120, 107.5), "kinect-v1": (160, 120, 145.0)}  # a quarter of their own
    for name, (width, height, focal) in rigs.items():
        rig = f"{{ width = {width}, height = {height}, focal = {focal} }}"
        lines = f'base = "{name}"\nrig = {rig}\npattern = {{ columns = 135, rows = 90 }}\n'
        (tmp_path / f"small-{name}.toml").write_text(lines)
    sensors = ",".join(str(tmp_path / f"small-{name}.toml") for name in rigs)
    command = ("generate", "--recipe", "rooms", "--classes", "chair", "plant", "--per-class", 1,
           "--scans-per-mesh", 2, "--sensor", sensors, "--views", 2, "--num-points", 64,
           "--seed", 2, "--variant", "scalar_rgb", "--samples", 1,
           "--least-pixels", 60)  # fmt: skip
    for name, workers in (("a", 0), ("b", 1)):
        printed = typed(*command, "--out", tmp_path / name, "--workers", workers).stderr
        assert "--source-cloud all" in printed
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in "ab")
    assert one == two
    assert "shard-00000.parquet" in one
    rows, drawn, settings = written(tmp_path / "a")
    assert {values["sensor"] for values in drawn} == {"small-d435", "small-kinect-v1"}
    assert {values["views"] for values in drawn} == {1, 2}
    for row, values in zip(rows, drawn, strict=True):
        assert max(row["clean_view"]) < values["views"] <= 2
        assert ("room.height.1" in values) is (values["views"] == 2)
        for kind in ("clean", "surface"):  # in metres, as large as was drawn
            extent = np.ptp(np.reshape(row[kind], (-1, 3)), axis=0).max()
            assert extent <= values["object_size"] * (1 + 1e-6)
    assert settings["recipe"] == "rooms"
    assert [one["name"] for one in settings["sensor"]] == ["small-d435", "small-kinect-v1"]
    assert "sensor: small-d435, small-kinect-v1" in typed("info", tmp_path / "a").stdout
    typed("info", "--check", tmp_path / "a")
    whole = load_clouds(tmp_path / "a", num_points=None, cloud="all")
    single = [load_clouds(tmp_path / "a", num_points=None, cloud=c).points
              for c in ("points", "clean", "surface")]  # fmt: skip
    np.testing.assert_array_equal(whole.points, np.concatenate(single))
    np.testing.assert_array_equal(whole.scan_rows(), np.tile(np.arange(4), 3))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "a").glob("*.parquet")}
    again = typed(*command, "--out", tmp_path / "a", "--workers", 0)
    assert "0 scans written, 4 were there before" in again.stderr
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_the_up_axis_holds_for_the_neighbour_too(monkeypatch, tmp_path):
    from qs3.cli import run
    from qs3.meshes import collections

    turned = []

    def watched(name, seed, up=None):
        turned.append((name, up))
        return load(name, seed, up)

    def stopped(*arguments, **options):
        raise InputError("both are read")

    load = collections.load_named
    monkeypatch.setattr("qs3.sensor.scan.scan", stopped)
    monkeypatch.setattr(collections, "load_named", watched)
    for name in ("a.stl", "b.stl"):
        trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / name)
    words = ["scan", tmp_path / "a.stl", "--neighbour", tmp_path / "b.stl", "--up", "y"]
    words += ["--scene", "beside", "--out", tmp_path / "scan"]
    with pytest.raises(InputError, match="both are read"):
        run([str(word) for word in words])
    assert turned == [(str(tmp_path / name), "y") for name in ("a.stl", "b.stl")]
