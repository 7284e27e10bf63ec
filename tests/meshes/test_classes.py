import json

import numpy as np
import pytest

from qs3.clouds.load import load_clouds
from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.meshes.classes import POINTDA10, canonical, check_class_names, map_labels, read_class_map
from qs3.store.manifest import MANIFEST, open_dataset


def test_canonical_folds_case_and_follows_aliases():
    for name, expected in {
        "Night Stand": "cabinet",
        "night-stand": "cabinet",
        "dresser": "cabinet",
        "Dining_Table": "table",
        "television": "monitor",
        "couch": "sofa",
        "potted plant": "plant",
        "toilet": "toilet",
    }.items():
        assert canonical(name) == expected


def test_classes_are_fixed_points_in_the_order_of_pointda10():
    assert list(POINTDA10) == sorted(POINTDA10)
    assert [canonical(name) for name in POINTDA10] == list(POINTDA10)


def test_map_labels_names_what_it_cannot_map_or_drops_it():
    names, labels = ["desk", "toilet", "bed"], np.array([2, 1, 0, 1])
    with pytest.raises(InputError, match="'toilet'"):
        map_labels(names, labels)
    mapped, kept = map_labels(names, labels, unmapped="drop")
    assert [POINTDA10[i] for i in mapped] == ["bed", "table"]
    assert kept.tolist() == [True, False, True, False]


def test_a_class_without_a_cloud_need_not_map():
    mapped, _ = map_labels(["toilet", "bed"], np.array([1, 1]))
    assert mapped.tolist() == [1, 1]


def test_a_name_that_both_sides_have_is_not_an_alias():
    names = ["desk", "dresser", "night_stand", "table"]
    mapped, _ = map_labels(names, np.arange(4), to=names)
    assert mapped.tolist() == [0, 1, 2, 3]


def test_a_class_comes_before_its_alias_where_a_list_has_both():
    to = ("desk", "table", "chair")
    labels, kept = map_labels(["dining_table", "desk", "Arm Chair"], np.array([0, 1, 2]), to)
    assert kept.all()
    assert [to[i] for i in labels] == ["table", "desk", "chair"]


def test_of_several_aliases_none_is_guessed():
    for name, to in [("chair", ["armchair", "stool"]), ("bench", ["armchair", "stool"])]:
        with pytest.raises(InputError, match=f"'{name}' is not one of: armchair, stool.*--map"):
            map_labels([name], np.array([0]), to)
    # The one alias that a list has is meant, in either direction.
    assert map_labels(["cabinet"], np.array([0]), ["mug", "night_stand"])[0].tolist() == [1]
    assert map_labels(["dresser"], np.array([0]), ["mug", "night_stand"])[0].tolist() == [1]


def test_a_map_is_lines_of_names(tmp_path):
    path = tmp_path / "classes.toml"
    path.write_text('stool = "chair"\n"arm chair" = "chair"\n')
    assert read_class_map(path) == {"stool": "chair", "arm chair": "chair"}
    twice = 'stool = "chair"\nstool = "seat"'
    others = ("stool = 3", 'stool = " "', "[chair]\na = 1", "stool: chair", 'stool = "a\\nb"')
    paths = ('stool = "../../x"', f'stool = "{"x" * 300}"', f"{'a.' * 3000}b = 1")
    for text in (twice, *others, *paths):
        path.write_text(text)
        with pytest.raises(InputError, match=r"classes\.toml: .*stool = \"chair\""):
            read_class_map(path)
    with pytest.raises(InputError, match="no such file"):
        read_class_map(tmp_path / "none.toml")


@pytest.mark.parametrize(
    "names",
    [
        ("a", "a"),
        ("a", " "),
        ("caf\u00e9", "cafe\u0301"),
        ("../../x",),
        ("a/b",),
        (".a",),
        ("x" * 300,),
        ("a\x1b[2J",),
        "ab",
        (1,),
    ],
)
def test_class_names_that_fit_no_folder_or_terminal_are_refused_wherever_they_enter(
    tmp_path, names
):
    with pytest.raises(InputError, match="class"):
        check_class_names(names)
    if isinstance(names, str) or not isinstance(names[0], str):
        return
    points, labels = np.random.default_rng(0).random((2, 9, 3)).astype(np.float32), np.zeros(2, int)
    ids = ("0", "1")
    with pytest.raises(InputError, match="class"):
        PointClouds(points, labels, names, ids)
    np.savez(tmp_path / "a.npz", points=points, label=labels, class_names=np.array(names))
    with pytest.raises(InputError, match=r"a\.npz: class"):
        load_clouds(tmp_path / "a.npz")
    value = {"settings": {}, "class_names": list(names), "rows": 0, "shards": 0, "versions": {}}
    (tmp_path / MANIFEST).write_text(json.dumps({**value, "schema": 3}))
    with pytest.raises(InputError, match=rf"{MANIFEST}: .*class"):
        open_dataset(tmp_path)
