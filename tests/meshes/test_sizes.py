"""Real sizes: a mesh's own unit in metres, and lengths drawn from the ranges of its class."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy import stats

from qs3 import shapes
from qs3.errors import TOLD, InputError
from qs3.meshes import collect, load_mesh
from qs3.meshes.classes import POINTDA10
from qs3.meshes.sizes import CLASS_SIZES, class_size, file_size
from qs3.store.plan import make_plan
from qs3.store.scan_item import GenerateSettings


def part(length: float) -> trimesh.Trimesh:
    return trimesh.creation.box((length, length / 2, length / 3))


@pytest.mark.parametrize(
    ("length", "unit", "metres"),
    [
        *((60.0, "mm", 0.06), (60.0, "cm", 0.6), (10.0, "in", 0.254), (2.0, "m", 2)),
        *((2.0, None, 2), (60.0, None, 0.06)),  # guessed
    ],
)
def test_a_length_in_a_unit_is_that_many_metres(length, unit, metres):
    size, named = file_size(part(length), unit)
    assert size == pytest.approx(metres, rel=1e-12)
    assert named == (unit or ("m (guessed)" if metres == 2 else "mm (guessed)"))


def test_a_mesh_that_tells_its_unit_is_believed(tmp_path):
    part(2.0).export(tmp_path / "part.glb")
    part(2.0).export(tmp_path / "part.off")
    assert file_size(load_mesh(tmp_path / "part.glb")) == (2.0, "m")
    assert load_mesh(tmp_path / "part.off").units is None
    for ending, begin, comment in (
        ("off", "OFF", "# unit: cm"),
        ("obj", "", "# File units = centimeters"),
        ("obj", "", "# made by X (units: cm)"),
        ("obj", "", "# This file uses centimeters as units for non-parametric coordinates.\n"),
        ("ply", "ply", "comment units cm"),
    ):
        text = part(2.0).export(
            file_type=ending, **({"encoding": "ascii"} if begin == "ply" else {})
        )
        text = text if isinstance(text, str) else text.decode()
        (tmp_path / f"b.{ending}").write_text(f"{begin}\n{comment}{text.removeprefix(begin)}")
        assert file_size(load_mesh(tmp_path / f"b.{ending}")) == (pytest.approx(0.02), "cm")
    assert file_size(shapes.make("bed"))[1] == "m"
    mesh = part(60.0)
    mesh.units = "0.01 * meters"  # as DAE has it
    assert file_size(mesh) == (pytest.approx(0.6), "cm")
    mesh.units = "feet"
    mesh.apply_scale(0.1)
    assert file_size(mesh) == (pytest.approx(6 * 0.3048), "feet")


@pytest.mark.parametrize(
    ("head", "unit", "is_said"),
    [
        ("UNITS=        mm", "mm", False),
        ("units: in", "in", False),
        ("solid units: inch", "in", False),
        ("solid part, made by X (unit: cm)", "cm", False),
        ("STLB ATF UNITS=mm", None, True),
        ("solid unit m6 bolt in mm", None, False),
    ],
)
def test_the_head_of_an_stl_may_name_the_unit(tmp_path, caplog, head, unit, is_said):
    TOLD.clear()
    is_text = head.startswith("solid")
    data = part(2.0).export(file_type="stl_ascii" if is_text else "stl")
    if is_text:
        data = f"{head}\n{data.partition(chr(10))[2]}".encode()
    else:
        data = head.encode().ljust(80, b"\0") + data[80:]
    (tmp_path / "a.stl").write_bytes(data)
    assert load_mesh(tmp_path / "a.stl").units == unit
    assert ("does not count as the unit of points" in caplog.text) == is_said
    assert "x00" not in caplog.text


def test_a_mesh_of_a_known_unit_is_believed_and_says_so_once(caplog):
    TOLD.clear()
    mesh = part(60.0)
    mesh.units = "cm"
    for _ in range(2):
        assert file_size(mesh, "mm") == (pytest.approx(0.6), "cm")
    assert caplog.messages == ["a mesh is in cm by what it says, not units mm"]
    caplog.clear()
    mesh.units = "millimeters"
    assert file_size(mesh, "mm")[0] == pytest.approx(0.06)
    assert not caplog.messages


def test_a_unit_that_is_named_wins_over_what_a_file_says_and_says_so_once(caplog, tmp_path):
    TOLD.clear()
    for name in ("a.glb", "b.glb"):
        part(60.0).export(tmp_path / name)
        mesh = load_mesh(tmp_path / name)
        assert file_size(mesh, "mm") == (pytest.approx(0.06), "mm")
    (line,) = caplog.messages
    assert line.startswith(f"{tmp_path / 'a.glb'} is in meters")
    assert "taken for units mm" in line
    with pytest.raises(InputError, match="name its unit"):
        file_size(mesh)
    part(0.06).export(tmp_path / "c.glb")
    with pytest.raises(
        InputError, match=r"0\.06 mm long.*; leave out the unit, as this file has its"
    ):
        file_size(load_mesh(tmp_path / "c.glb"), "mm")
    mesh.metadata["file_name"] = "a.step"  # its numbers are the reader's, not the file's
    with pytest.raises(InputError, match="m; give a size"):
        file_size(mesh, "mm")


def test_guesses_that_differ_within_a_collection_are_refused(tmp_path):
    (tmp_path / "things").mkdir()
    for name, length in (("bracket", 600.0), ("plate", 90.0), ("broken", 1.0)):
        part(length).export(tmp_path / "things" / f"{name}.stl")
    (tmp_path / "things" / "broken.stl").write_text("solid")
    settings = GenerateSettings(sensor="d435", object_size="file", classes=("things",))
    make_plan(collect(tmp_path), settings).check_sizes()
    part(3.0).export(tmp_path / "things" / "screw.stl")
    with pytest.raises(InputError, match=r"things/screw .*metres.*things/bracket .*--units"):
        make_plan(collect(tmp_path), settings).check_sizes()
    make_plan(collect(tmp_path), dataclasses.replace(settings, units="mm")).check_sizes()
    part(0.3).export(tmp_path / "things" / "screw.glb")  # tells its unit
    (tmp_path / "things" / "screw.stl").unlink()
    make_plan(collect(tmp_path), settings).check_sizes()


@pytest.mark.parametrize(
    ("length", "unit", "message"),
    [
        (60.0, "m", "60 m long.*units"),
        (60_000.0, None, r"mm \(guessed\) long, which is 60 m"),
        (1e-4, None, "no object of 0.001 to 10 m"),
    ],
)
def test_what_is_no_object_is_refused(length, unit, message):
    with pytest.raises(InputError, match=message) as caught:
        file_size(part(length), unit)
    assert "\n" not in str(caught.value)


def test_an_unknown_unit_is_refused():
    mesh = part(1.0)
    mesh.units = "cubits"
    with pytest.raises(InputError, match=r"cubits.*units"):
        file_size(mesh)


@pytest.mark.parametrize("name", POINTDA10)
def test_sizes_of_a_class_keep_to_both_of_its_ranges(name):
    longest, heights = CLASS_SIZES[name]
    for seed in range(10):
        mesh = shapes.make(name, seed=seed)
        size = class_size(mesh, name, np.random.default_rng(seed))
        assert longest[0] - 1e-9 <= size <= longest[1] + 1e-9
        height = size * mesh.extents[2] / mesh.extents.max()
        possible = [side * mesh.extents[2] / mesh.extents.max() for side in longest]
        if possible[0] <= heights[1] and possible[1] >= heights[0]:  # its shape allows it
            assert heights[0] - 1e-9 <= height <= heights[1] + 1e-9
        assert size == class_size(mesh, name, np.random.default_rng(seed))


def test_sizes_are_uniform_in_the_logarithm_at_any_scale_of_the_mesh():
    rng = np.random.default_rng(0)
    draws = [class_size(part(10.0**s), "Floor Lamp", rng) for s in np.linspace(-3, 3, 300)]
    low, high = 3 * CLASS_SIZES["lamp"][1][0], CLASS_SIZES["lamp"][0][1]  # as high as a third
    span = stats.loguniform(low, high)
    assert stats.kstest(draws, span.cdf).pvalue > 0.01


def test_a_class_without_a_size_is_refused():
    with pytest.raises(InputError, match=r"'toilet'.*bathtub"):
        class_size(part(1.0), "toilet", np.random.default_rng(0))
    with pytest.raises(InputError, match=r"no class.*--class-name"):
        class_size(part(1.0), "", np.random.default_rng(0))


def test_the_table_holds_published_means_and_what_real_views_show(shared_data):
    means = {
        "bathtub": (1.398, 0.473),
        "bed": (2.114, 0.927),
        "bookshelf": (1.689, 1.689),
        "cabinet": (1.173, 1.173),
        "chair": (0.827, 0.827),
        "sofa": (1.867, 0.845),
        "table": (1.280, 0.718),
    }  # VoteNet's type_mean_size; the dresser's for the cabinet
    for name, mean in means.items():
        for value, (low, high) in zip(mean, CLASS_SIZES[name], strict=True):
            assert low < value < high
    real = dict(np.load(shared_data / "nyuv2_objects.npz"))
    longest = np.ptp(real["points"].astype(np.float32), axis=1).max(axis=1)
    for index, name in enumerate(real["class_names"].tolist()):
        seen = longest[real["strict"].astype(bool) & (real["label"] == index)]
        assert np.quantile(seen, 0.95) <= CLASS_SIZES[name][0][1]
