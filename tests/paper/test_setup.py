"""What a folder is for: its marker lives on as settings are added, and damage is told."""

import json
from dataclasses import replace

import pytest

from qs3.errors import InputError
from qs3.paper.scales import SCALES
from qs3.paper.setup import claim, read_setup

from .conftest import TINY


@pytest.mark.parametrize(
    "damage",
    [
        {"data": []},
        {"data": {"D": ["a", "points"]}},
        {"threads": "a"},
        {"scale": {"name": 3}},
        {"more": 1},
        {"version": 9},
    ],
)
def test_a_damaged_marker_is_reported(whole, tmp_path, damage):
    value = json.loads((whole / "bench.json").read_text())
    (tmp_path / "bench.json").write_text(json.dumps(value | damage))
    with pytest.raises(InputError, match=r"bench\.json"):
        read_setup(tmp_path)


def test_a_folder_without_a_marker_is_reported(tmp_path):
    with pytest.raises(InputError, match=r"has no bench\.json"):
        read_setup(tmp_path)


def test_a_folder_of_an_earlier_release_is_read(whole, tmp_path):
    value = json.loads((whole / "bench.json").read_text())
    value["scale"] |= {"tasks": ["M-D"], "pointda10": ["ordinary"]}
    value["scale"]["train"]["ema_decay"] = None
    value["scale"]["train"]["preparation"]["height_input"] = False
    (tmp_path / "bench.json").write_text(json.dumps(value))
    assert read_setup(tmp_path).scale == read_setup(whole).scale


def test_a_folder_keeps_its_scale_if_ours_changes(whole):
    assert read_setup(whole).scale.train.num_points == TINY.train.num_points
    assert read_setup(whole).scale != SCALES["smoke"]


def test_other_usual_columns_fit_a_folder_and_another_size_does_not(whole, tmp_path):
    (tmp_path / "bench.json").write_bytes((whole / "bench.json").read_bytes())
    setup = read_setup(tmp_path)
    claim(replace(setup, scale=replace(setup.scale, sources=("S-D",))))
    assert read_setup(tmp_path) == replace(setup, scale=replace(setup.scale, sources=("S-D",)))
    with pytest.raises(InputError, match=r"holds a bench with scale\.data_points = \d+, not 7;"):
        claim(replace(setup, scale=replace(setup.scale, data_points=7)))
