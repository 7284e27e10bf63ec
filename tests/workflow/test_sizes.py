"""Sizes of CAD and scans: wrong units, several parts and tables are told before a scan."""

import re

import numpy as np
import pytest

from qs3.answers.cloud_files import ListedCloud
from qs3.errors import InputError
from qs3.parts.loaded_forest import METRIC
from qs3.runs.checks import measure_sizes, require_size
from qs3.workflow.sizes import compare_sizes, likely_unit, reach, too_large

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
SIDES = np.array([0.035, 0.05, 0.08, 0.12])


def scans(sides, rng, each=6):
    """Reaches of scans of parts: three fifths of the part to all of it."""
    return (sides[:, None] * rng.uniform(0.6, 1.0, (len(sides), each))).ravel()


@pytest.mark.parametrize("right", METRES)
@pytest.mark.parametrize("taken", METRES)
def test_a_unit_that_is_ten_times_off_is_found(right, taken):
    """Of scans of all parts, of the smallest alone and of the largest alone."""
    rng = np.random.default_rng(0)
    ratio = METRES[taken] / METRES[right]
    for part in (SIDES, SIDES[:1], SIDES[-1:]):
        found = likely_unit(ratio * SIDES, scans(part, rng), [taken])
        if taken == right:
            assert found is None
        elif not 1 / 9 < ratio < 9:  # a centimetre and an inch may be told apart, or not
            assert found is not None
            assert len(part) < len(SIDES) or found == right


@pytest.mark.parametrize(("factor", "unit"), [(100, "cm"), (39.37, "in")])
def test_scans_in_another_unit_are_found(factor, unit):
    sizes = factor * scans(SIDES, np.random.default_rng(1))
    assert likely_unit(SIDES, sizes, ["mm"]) == unit


def test_parts_of_many_sizes_are_not_doubted():
    rng = np.random.default_rng(2)
    sides = np.geomspace(0.01, 0.3, 18)
    for part in (sides, sides[:3], sides[-3:], sides[8:9]):
        for unit in METRES:
            assert likely_unit(sides, scans(part, rng), [unit]) is None


def cloud(name, side, rng):
    return ListedCloud(name, (rng.random((400, 3)) * side / 3**0.5).astype(np.float32))


def named(sides):
    return {f"{i}.stl": float(side) for i, side in enumerate(sides)}


def test_clouds_larger_than_every_part_cost_themselves_or_all(tmp_path):
    rng = np.random.default_rng(3)
    files = [cloud(tmp_path / f"{i}.ply", side, rng) for i, side in enumerate(SIDES)]
    table = cloud(tmp_path / "table.ply", 0.25, rng)
    (fault,) = compare_sizes(named(SIDES), [*files, table], [], ("cad", "scans"))
    assert fault.file.name == "table.ply"
    assert "several parts, or the table?" in fault.fault
    millimetres = cloud(tmp_path / "mm.ply", 60.0, rng)
    (fault,) = compare_sizes(named(SIDES), [*files, millimetres], [], ("cad", "scans"))
    assert "is it in millimetres?" in fault.fault
    assert "--force" not in fault.fault  # which would not answer it
    frames = [cloud(tmp_path / f"f{i}.ply", 0.25, rng) for i in range(6)]
    with pytest.raises(InputError, match=r"6 of 10 scans are larger than every part.*--force"):
        compare_sizes(named(SIDES), [*files, *frames], [], ("cad", "scans"))


@pytest.mark.parametrize(
    ("size", "advice"),
    [
        (60.0, "in millimetres? Divide by 1000"),
        (8.0, "in centimetres? Divide by 100"),
        (4.0, "in inches? Divide by 39.37"),
        (40.0, "in millimetres? Divide by 1000"),  # also of the smallest part
    ],
)
def test_the_unit_of_a_scan_is_the_same_before_a_training_and_after_it(tmp_path, size, advice):
    one, *learnt = (
        cloud(tmp_path / "a.ply", side, np.random.default_rng(7)) for side in (size, *SIDES)
    )
    (fault,) = too_large(SIDES, [one])
    assert fault.fault.endswith(f"is it {advice}")
    with pytest.raises(InputError) as refused:
        sizes = measure_sizes(np.stack([part.points for part in learnt]))
        require_size(one.points[None], METRIC, sizes)
    assert str(refused.value).endswith(f"are they {advice}")


def test_a_scan_that_is_no_part_in_another_unit_is_of_several(tmp_path):
    for size, sides in ((1.7, [0.2, 0.6]), (1.4, [0.03, 0.05])):  # the last may be a table
        one = cloud(tmp_path / "pile.ply", size, np.random.default_rng(8))
        (fault,) = too_large(np.array(sides), [one])
        assert fault.fault.endswith("several parts, or the table? (--force answers it)")


@pytest.mark.parametrize("factor", [1 / 25.4, 25.4])
def test_a_file_in_another_unit_than_the_others_is_named(tmp_path, caplog, factor):
    rng = np.random.default_rng(6)
    files = [cloud(tmp_path / f"{i}.ply", side, rng) for i, side in enumerate(SIDES)]
    compare_sizes(named(SIDES), files, ["mm"], ("cad", "scans"))
    assert not caplog.text
    compare_sizes({**named(SIDES), "odd.stl": factor * 0.05}, files, ["mm"], ("cad", "scans"))
    assert re.search(r"cad: odd.stl \(.*none can be of it", caplog.text)


@pytest.mark.parametrize("factor", [0.1, 0.001])
def test_scans_far_smaller_than_every_part_are_refused(tmp_path, factor):
    rng = np.random.default_rng(4)
    files = [cloud(tmp_path / f"{i}.ply", factor * side, rng) for i, side in enumerate(SIDES[1:])]
    with pytest.raises(InputError, match=r"far smaller than every part.*--force goes on"):
        compare_sizes(named(SIDES[1:]), files, ["mm"], ("cad", "scans"))


def test_the_reach_does_not_depend_on_the_pose():
    rod = np.linspace([0, 0, 0], [0.1, 0, 0], 200)
    for seed in range(5):
        turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
        assert reach(rod @ turn) == pytest.approx(0.1, rel=0.03)
