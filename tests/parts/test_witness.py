"""The witness of a run: what a scan's CAD says, kept in the folder of a run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.adaptation.confidence import Known
from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.geometry import transform_points
from qs3.meshes import collect
from qs3.meshes.loading import is_turned
from qs3.parts import LIBRARY, Library, Place, locate
from qs3.parts.cad import calibrate, read_cad
from qs3.parts.forest_and_cad import Fusion, Judged, measure_fusion
from qs3.parts.forest_training import HeldOut
from qs3.parts.locating import Location, compare, located
from qs3.parts.visible import visible
from qs3.parts.witness import Witness

from ..stores import view_once

BLOCK = trimesh.util.concatenate(
    [
        trimesh.creation.box((0.06, 0.03, 0.01)),
        trimesh.creation.box((0.01, 0.03, 0.04)).apply_translation((0.025, 0, 0.02)),
        trimesh.creation.box((0.02, 0.008, 0.02)).apply_translation((-0.02, 0.011, 0.012)),
    ]
)
"""It has no symmetry."""
ROD = trimesh.creation.cylinder(0.01, 0.08)
CAMERA = Place(camera=(0.0, 0.0, 0.0))
NAMES = ("block", "rod")
EVEN = {"block": 0.5, "rod": 0.5}


def seen(witness: Witness, name: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a part that a camera at the origin sees, and the part's pose."""
    (part,) = (part for part in witness.library if part.class_name == name)
    pose = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    pose[:3, 3] = (0.02, -0.03, 0.5)
    rows = visible(part.points, part.spacing, np.linalg.inv(pose)[:3, 3], part.middle)
    noise = np.random.default_rng(seed).normal(0, 0.0003, (len(rows), 3))
    return transform_points(pose, part.points[rows].astype(np.float64)) + noise, pose


@pytest.fixture(scope="module")
def witness(tmp_path_factory) -> Witness:
    folder = tmp_path_factory.mktemp("cad")
    for name, mesh in zip(NAMES, (BLOCK, ROD), strict=True):
        mesh.copy().apply_scale(1000).export(folder / f"{name}.stl")
    return read_cad(collect(folder), NAMES, "mm")


def test_weights_are_measured_on_what_predict_compares(witness: Witness, monkeypatch) -> None:
    """That is the CAD of the likeliest class, and the other's if the scan is lost by its limit."""
    compared = []

    def counted(library, *words):
        compared.append(library.class_names)
        return compare(library, *words)

    def all_lost(candidates):  # by the limit without a run, which has no say
        found = located(candidates).candidates
        return Location(tuple(replace(candidate, lost=True) for candidate in found))

    monkeypatch.setattr("qs3.parts.witness.SEARCHED", 1)
    monkeypatch.setattr("qs3.parts.witness.located", all_lost)
    monkeypatch.setattr("qs3.parts.witness.compare", counted)
    labels, rng = np.arange(24) % 2, np.random.default_rng(0)
    clouds = [rng.choice(seen(witness, NAMES[label], k)[0], 400) for k, label in enumerate(labels)]
    answers = np.where(np.arange(24) < 2, 1 - labels, labels)  # two are sure and wrong
    shares = np.where(np.eye(2, dtype=bool)[answers], 0.995, 0.005)
    held_out = HeldOut(np.arange(24), shares, np.full(24, 0.5), Known(1.0, (0.0, 1.0), 24), 22 / 24)
    ids = tuple(f"{k}/points" for k in range(24))
    weighed = calibrate(witness, PointClouds(np.stack(clouds), labels, NAMES, ids), held_out, {})
    assert weighed.fusion.worst is not None
    lost = [(NAMES[label],) for label in labels[:2]]
    assert compared == [*((NAMES[answer],) for answer in answers), *lost]


@pytest.mark.parametrize(
    ("file", "units", "up"),
    [("part.stl", "mm", None), ("part.stl", "mm", "y"), ("part.obj", "m", "y"),
     ("part.glb", None, None), ("part.glb", None, "z")],
)  # fmt: skip
def test_a_pose_belongs_to_the_file_as_it_stands_on_disk(tmp_path, file, units, up) -> None:
    """Whatever its up axis and unit; another program loads the file and finds the part there."""
    (tmp_path / "cad" / "part").mkdir(parents=True)
    path, factor = tmp_path / "cad" / "part" / file, 1000 if units == "mm" else 1
    mesh = BLOCK.copy().apply_scale(factor)
    mesh.export(path)
    assert is_turned(path, up) == (up == "y" or (up is None and file.endswith("glb")))
    library = read_cad(collect(tmp_path / "cad", up=up), ("part",), units)
    points, pose = seen(library, "part")
    found = library.look({"part": 1.0}, points, CAMERA).best
    assert found is not None
    assert found.cad == "part/part"
    loaded = trimesh.load(path, force="mesh").apply_scale(1 / factor)
    moved = transform_points(found.pose, np.asarray(loaded.vertices, dtype=np.float64))
    placed = transform_points(pose, np.asarray(loaded.vertices, dtype=np.float64))
    assert np.abs(moved - placed).max() < 0.002
    (edges,) = library.edges.values()
    assert np.ptp(edges.reshape(-1, 3), axis=0) == pytest.approx(loaded.extents, abs=1e-6)


def test_the_cad_overrules_an_undecided_forest(witness) -> None:
    for name in NAMES:
        points, _ = seen(witness, name)
        looked = witness.look(EVEN, points, CAMERA)
        assert next(iter(looked.probabilities)) == name
        assert looked.best is not None
        assert not looked.best.lost
        assert looked.probabilities[name] > 0.8
        assert sum(looked.probabilities.values()) == pytest.approx(1)


def test_classes_that_the_forest_rules_out_are_searched_if_the_others_are_lost(
    witness, monkeypatch
) -> None:
    monkeypatch.setattr("qs3.parts.witness.SEARCHED", 1)
    points, _ = seen(witness, "block")
    looked = witness.look({"rod": 0.999, "block": 0.001}, points, CAMERA)
    assert {one.class_name for one in looked.candidates} == {"rod", "block"}
    sure, _ = seen(witness, "rod")
    looked = witness.look({"rod": 0.999, "block": 0.001}, sure, CAMERA)
    assert [one.class_name for one in looked.candidates] == ["rod"]


def test_a_class_that_cannot_hold_the_scan_is_told_from_one_that_was_not_compared(
    witness, monkeypatch
) -> None:
    pea = view_once(trimesh.creation.icosphere(3, 0.004), 1.0, "pea", "pea")
    small = Witness(Library((*witness.library, pea)), witness.edges)
    points, _ = seen(witness, "rod")
    names = ("rod", "block", "pea")
    looked = small.look({"pea": 0.6, "rod": 0.3, "block": 0.1}, points, CAMERA)
    assert looked.compared == {*names}
    assert looked.agreed(names)[2, 0] == np.inf
    assert [*looked.probabilities] == ["rod", "block", "pea"]
    monkeypatch.setattr("qs3.parts.witness.SEARCHED", 2)
    looked = small.look({"pea": 0.6, "rod": 0.395, "block": 0.005}, points, CAMERA)
    assert looked.compared == {"rod", "pea"}
    assert np.isnan(looked.agreed(names)[1, 0])
    # One CAD alone can hold the scan: that says a lot.
    assert looked.probabilities["rod"] > 0.95
    # The likeliest class is so small that the scan seems to be in another unit: it is not.
    monkeypatch.setattr("qs3.parts.witness.SEARCHED", 1)
    grain = view_once(trimesh.creation.icosphere(3, 0.001), 1.0, "grain", "grain")
    tiny = Witness(Library((*witness.library, grain)), witness.edges)
    looked = tiny.look({"grain": 0.992, "rod": 0.004, "block": 0.004}, points, CAMERA)
    assert next(iter(looked.probabilities)) == "rod"


def smoothed(points: np.ndarray, rng: np.random.Generator, high: float = 0.008) -> np.ndarray:
    """Return points that a stereo camera moved in depth, by waves of 4 cm."""
    ways, phases = rng.random((2, 6)) * 2 * np.pi
    waves = np.stack([np.cos(ways), np.sin(ways)]) * 2 * np.pi / 0.04
    depth = np.sin(points[:, :2] @ waves + phases).sum(axis=1) * high / np.sqrt(3)
    return points + depth[:, None] * (0, 0, 1)


def test_scans_as_smooth_as_the_runs_own_are_not_lost_and_others_are(witness, tmp_path) -> None:
    """Stereo moves a surface as a whole: the plane through neighbours does not show it."""
    rng = np.random.default_rng(0)
    wavy = [(name, smoothed(seen(witness, name, seed)[0], rng))
            for seed in range(25) for name in NAMES]  # fmt: skip
    smooth, others = wavy[:24], wavy[30:38]
    exact = [(name, seen(witness, name, seed)[0]) for seed in range(6) for name in NAMES]

    def lost(one: Witness, scans) -> float:
        answers = [one.look({name: 0.99, other: 0.01}, points).best
                for name, points in scans for other in NAMES if other != name]  # fmt: skip
        return float(np.mean([best is None or best.lost for best in answers]))

    def measured(scans) -> Witness:
        looks = [witness.look(EVEN, points) for _, points in scans]
        count = len(scans)
        known = Judged(
            NAMES, np.array([NAMES.index(name) for name, _ in scans]), np.full(count, 1000),
            np.full((count, 2), 0.5), np.full(count, 0.5),
            np.stack([one.agreed(NAMES) for one in looks]),
            np.stack([one.disagreement(NAMES) for one in looks]), np.full(count, True),
        )  # fmt: skip
        return replace(witness, fusion=measure_fusion(known))

    shallow = [(name, smoothed(seen(witness, name, seed)[0], rng, 0.0045))
               for seed in range(10) for name in NAMES]  # fmt: skip
    assert lost(witness, shallow) < 0.3  # along the line of sight noise counts less
    assert lost(witness, others) > 0.5
    run = measured(smooth)
    assert lost(run, others) < 0.1
    ball = trimesh.creation.icosphere(3, 0.03)
    foreign = view_once(ball, 1.0, "ball", "ball")
    scan = seen(Witness(Library((foreign,)), {}), "ball")[0]
    for one in (scan, smoothed(scan, rng)):
        best = measured(exact).look(EVEN, one).best
        assert best is None or best.lost
    run = replace(run, placed=measured(exact).fusion.of_shown([("rod", 1.0, 0.8)] * 20))
    run.save(tmp_path)
    again = Witness.read(tmp_path, NAMES)
    assert (again.fusion, again.placed) == (run.fusion, run.placed)
    assert again.fusion_for(Place(True)) == run.placed
    assert again.fusion_for(Place(camera=(0.0, 0.0, 1.0))) == run.fusion


def test_a_wrong_place_costs_no_pose(witness) -> None:
    """Behind the part the camera would see another side of it."""
    for name in NAMES:
        points, _ = seen(witness, name)
        found = witness.look(EVEN, points, Place(camera=(0.0, 0.0, 1.0))).best
        assert found is not None
        assert (found.class_name, found.lost) == (name, False)
        assert found.residual < 0.001


def test_a_scan_that_is_larger_than_all_cad_has_no_pose(witness) -> None:
    assert witness.look(EVEN, seen(witness, "rod")[0] * 4).candidates == ()


def test_what_was_compared_is_not_compared_again(witness, monkeypatch) -> None:
    points, known = seen(witness, "block")[0], {}
    looked = witness.look(EVEN, points, CAMERA, known)
    monkeypatch.setattr("qs3.parts.witness.compare", None)
    calm = replace(witness, fusion=replace(witness.fusion, witness=0.5))
    again = calm.look(EVEN, points, CAMERA, known)
    assert [one.cad for one in again.candidates] == [one.cad for one in looked.candidates]
    assert again.probabilities != looked.probabilities


def test_a_part_of_which_little_is_seen_is_lost_if_simulated_scans_show_more(witness) -> None:
    whole, _ = seen(witness, "block")
    scrap = whole[whole[:, 0] <= np.quantile(whole[:, 0], 0.3)]
    for shown, is_lost in ((0.0, False), (0.6, True)):
        run = replace(witness, fusion=Fusion(worst=9.0, shown=shown))
        assert [run.look(EVEN, scan).best.lost for scan in (whole, scrap)] == [False, is_lost]


def test_a_saved_witness_says_the_same(witness, tmp_path: Path) -> None:
    witness.save(tmp_path)
    again = Witness.read(tmp_path, NAMES)
    points, _ = seen(witness, "block")
    one, other = (each.look(EVEN, points, CAMERA) for each in (witness, again))
    assert one.probabilities == other.probabilities
    assert np.array_equal(one.candidates[0].pose, other.candidates[0].pose)
    with pytest.raises(InputError, match="holds CAD of block, rod, and the forest knows bolt"):
        Witness.read(tmp_path, ("bolt",))
    (tmp_path / LIBRARY).write_bytes(b"no library")
    with pytest.raises(InputError, match=LIBRARY):
        Witness.read(tmp_path, NAMES)


def test_a_library_takes_less_than_a_megabyte_a_mesh(witness, tmp_path: Path) -> None:
    witness.save(tmp_path)
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert size < 1e6 * len(NAMES)


def test_a_pose_disagrees_more_if_another_file_agrees_better(witness) -> None:
    """Else a forest that is sure would name a class that the CAD contradicts."""
    first, second = locate(witness.library, seen(witness, "block")[0]).candidates
    assert (first.class_name, first.beaten) == ("block", 1)
    assert second.beaten == pytest.approx(second.misfit / first.misfit)
    plain = second.misfit * second.off / second.noise
    assert second.disagreement == pytest.approx(plain * second.beaten**2)
    assert located([second]).candidates[0].disagreement == pytest.approx(plain)
