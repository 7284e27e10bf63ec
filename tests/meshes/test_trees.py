"""Trees of ModelNet, of ShapeNet and of one's own; PointDA-10's ten classes in each."""

import os
import unicodedata
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.errors import InputError
from qs3.meshes import MeshItem, collect
from qs3.meshes.classes import MODELNET40, POINTDA10, SHAPENET
from qs3.meshes.collections import rename_items
from qs3.store.plan import make_plan
from qs3.store.scan_item import GenerateSettings

# Folders of ModelNet40 as published, apart from the library's own list.
FOLDERS = """airplane,bathtub,bed,bench,bookshelf,bottle,bowl,car,chair,cone,cup,curtain,desk,door,
dresser,flower_pot,glass_box,guitar,keyboard,lamp,laptop,mantel,monitor,night_stand,person,piano,
plant,radio,range_hood,sink,sofa,stairs,stool,table,tent,toilet,tv_stand,vase,wardrobe,xbox"""


def renames(items: list[MeshItem]) -> set[tuple[str, str]]:
    return {(item.id.split("/")[0], item.class_name) for item in items}


def modelnet_names(per_folder: int = 1) -> list[str]:
    return [
        f"{name}/{split}/{name}_{i:04d}.off"
        for name in FOLDERS.replace("\n", "").split(",")
        for split in ("train", "test")
        for i in range(per_folder)
    ]


def test_pointda10_takes_ten_folders_of_modelnet_and_renames_one(tree) -> None:
    root = tree(*modelnet_names())
    assert {item.class_name for item in collect(root)} == MODELNET40
    assert len(MODELNET40) == 40
    items = collect(root, classes="pointda10")
    assert items == collect(root, classes=["pointda10"])
    same = {name for name in POINTDA10 if name != "cabinet"}
    assert renames(items) == {(name, name) for name in same} | {("night_stand", "cabinet")}
    assert len(items) == 20
    cabinet = next(item for item in items if item.class_name == "cabinet")
    assert cabinet.id == "night_stand/test/night_stand_0000"
    assert len(cabinet.load().faces) == 1
    assert {item.original_class for item in items} == {"", "night_stand"}
    assert make_plan(items, GenerateSettings()).manifest().renamed == {"night_stand": "cabinet"}


def test_a_map_merges_classes_and_a_built_in_shape_stays_what_it_is(tree) -> None:
    items = [*collect(tree("stool/a.off", "mug/b.off")), *collect("shapes", per_class=1)]
    named = rename_items(items, {"stool": "chair", "lamp": "light"})
    called = {(item.original_class, item.class_name) for item in named if item.original_class}
    assert called == {("stool", "chair"), ("lamp", "light")}
    lamp = next(item for item in named if item.original_class == "lamp")
    assert len(lamp.load().faces) > 0
    with pytest.raises(InputError, match="the map of classes names sofas, and none of bathtub"):
        rename_items(items, {"sofas": "sofa"})


@pytest.mark.parametrize(
    "names",
    [
        # "couch" is no class of ModelNet, so this is none of its trees.
        ["dresser/train/a.off", "couch/test/b.off", "Desk/train/c.off", "rocket/train/d.off"],
        ["dresser/train/a.off", "couch/b.off", "Desk/new/c.off", "rocket/d.off"],
    ],
)
def test_a_tree_of_ones_own_goes_by_the_table_of_aliases(tree, names) -> None:
    items = collect(tree(*names), classes="pointda10")
    assert renames(items) == {("dresser", "cabinet"), ("couch", "sofa"), ("Desk", "table")}


def test_none_of_the_ten_is_an_error_and_one_of_them_is_enough(tree) -> None:
    root = tree("rocket/d.off", "toilet/e.off")
    with pytest.raises(InputError, match=r"none of PointDA-10's ten classes; it has rocket, toil"):
        collect(root, classes="pointda10")
    bath = collect(tree("bath tub/a.off"), classes="pointda10")
    assert renames(bath) == {("bath tub", "bathtub")}


def test_pointda10_of_shapes_is_all_of_them() -> None:
    items = collect("shapes", per_class=1, classes="pointda10")
    assert tuple(item.class_name for item in items) == POINTDA10
    assert items == collect("shapes", per_class=1)


def test_faulty_choices_of_classes(tree) -> None:
    root = tree("chair/a.off")
    with pytest.raises(InputError, match="pointda10 stands for ten"):
        collect(root, classes=["pointda10", "chair"])
    with pytest.raises(InputError, match="at least one"):
        collect(root, classes=[])
    assert [item.id for item in collect(root, classes="chair")] == ["chair/a"]
    with pytest.raises(InputError, match=r"no class 'x'; it has chair"):
        collect(root, classes=["x"])
    with pytest.raises(InputError, match="no classes: it is flat"):
        collect(tree("flat/test/b.off") / "flat", classes=["chair"])


def test_shapenet_of_both_versions_with_and_without_splits(tree) -> None:
    root = tree(
        "04379243/bb/models/model_normalized.obj",
        "04379243/bb/models/model_normalized.json",
        "04379243/bb/model.obj",
        "04379243/bb/images/texture0.jpg",
        "04379243/aa/model.obj",
        "02992529/aa/models/model_normalized.obj",
        "02834778/cc/models/model_normalized.obj",
        "04379243/empty/images/x.jpg",
        "taxonomy.json",
    )
    found = [(item.id, item.class_name, item.split, item.up) for item in collect(root)]
    assert found == [
        ("02834778/cc/models/model_normalized", "02834778", "", "y"),
        ("02992529/aa/models/model_normalized", "cellular_telephone", "", "y"),
        ("04379243/aa/model", "table", "", "y"),
        ("04379243/bb/models/model_normalized", "table", "", "y"),
    ]
    (root / "all.csv").write_text(
        "id,synsetId,subSynsetId,modelId,split\n"
        "000001,04379243,04379243,aa,train\n"
        "000002,4379243,04379243,bb,val\n"
        "000003,02992529,02992529,aa,test\n"
        "000004,02992529,02992529,not_here,test\n"
    )
    assert [item.split for item in collect(root)] == ["", "test", "train", "val"]
    with (root / "all.csv").open("a") as handle:
        handle.write("000005,02992529,02992529,aa,train\n")
    with pytest.raises(InputError, match=r"all.csv, line 6: 02992529/aa is in 'train' and in 'te"):
        collect(root)
    (root / "all.csv").write_text("synset,model\n")
    with pytest.raises(InputError, match=r"all.csv, line 1: no column synsetid; it has 'synset'"):
        collect(root)


def test_pointda10_takes_ten_synsets_of_shapenet(tree) -> None:
    root = tree(*(f"{synset}/a/models/model_normalized.obj" for synset in SHAPENET))
    assert len(collect(root)) == 55
    assert len({item.class_name for item in collect(root)}) == 55
    ten = "02808440 02818832 02871439 02933112 03001627 "
    ten += "03636649 03211117 03991062 04256520 04379243"
    expected = set(zip(ten.split(), POINTDA10, strict=True))
    assert renames(collect(root, classes="pointda10")) == expected


def test_convention_shapenet_is_y_up(tree) -> None:
    root = tree("03001627/a/models/model_normalized.obj", "03001627/b/model.obj", "x/c.obj")
    for item in collect(root):
        # The triangle is 1 along x and 3 along y: the long side has to end up along z.
        tall = [1, 0, 3] if item.class_name == "chair" else [1, 3, 0]
        assert np.ptp(item.load().vertices, axis=0).tolist() == tall


def test_shapenet_in_another_form_is_refused(tree) -> None:
    root = tree("03001627/a.obj", "04379243/a/model.obj")
    with pytest.raises(InputError, match=r"03001627: named as a synset of ShapeNet, but"):
        collect(root)


def test_each_file_of_a_flat_folder_is_a_class(tree, caplog) -> None:
    root = tree("m20.stl", "bearing box.step", "m20.off")
    found = [(item.id, item.class_name) for item in collect(root)]
    assert found == [("bearing box", "bearing box"), ("m20.off", "m20"), ("m20.stl", "m20")]
    assert "each of its 3 files is a class" in caplog.text
    assert "files of one stem are one class: m20.off, m20.stl" in caplog.text
    both = collect(tree("gear/a.off", "gear.off"))
    assert {item.class_name for item in both} == {"m20", "bearing box", "gear"}
    assert "is a class, named by its stem: bearing box.step, gear.off, m20.off" in caplog.text


@pytest.mark.parametrize(
    ("meshes", "bare", "message"),
    [
        (["gear/a.off", "nut/a.off", "rod/drawing.pdf"], ["bolt", ".git"], "bolt, rod"),
        (["train/gear/a.off", "test/gear/b.off"], ["train/bolt", "val"], "train/bolt"),
        (["gear/a.off"], [f"c{n:02d}" for n in range(12)], "c09 and 2 more"),
        (["gear.off", "nut.off"], ["drawings"], None),
    ],
)
def test_folders_of_classes_without_a_mesh_are_named(tree, caplog, meshes, bare, message) -> None:
    root = tree(*meshes)
    for name in bare:
        (root / name).mkdir(parents=True)
    assert collect(root)
    notes = [text for text in caplog.messages if "no mesh in" in text]
    if message is None:
        assert not notes
    else:
        assert len(notes) == 1 and notes[0].endswith(f"{message}: no class is made of it")


def test_folders_beside_a_table_of_labels_are_not_named(tree, caplog) -> None:
    root = tree("a/x.off", "b/y.off", "images/z.png")
    (root / "labels.csv").write_text("file,class\na/x.off,gear\n")
    assert [item.class_name for item in collect(root, labels=root / "labels.csv")] == ["gear"]
    assert "no mesh in" not in caplog.text


@pytest.mark.parametrize(
    "tree_of",
    [
        {"indoor/chair/train/a.off": ("indoor", "train"), "outdoor/b.off": ("outdoor", "")},
        {
            "chair/arm/deep/a.off": ("chair", ""),
            "chair/arm/train/c.off": ("chair", "train"),
            "chair/test/arm/b.off": ("chair", "test"),
            "d.off": ("d", ""),
        },
        {
            "test/chair/deep/a.off": ("chair", "test"),
            "train/chair/a.off": ("chair", "train"),
            "val/b.off": ("", "val"),
        },
        {
            "bus/a.off": ("bus", ""),
            "train/test/c.off": ("train", "test"),
            "train/train/b.off": ("train", "train"),
        },
        {"Train/bus/a.off": ("bus", "train"), "Validation/bus/b.off": ("bus", "val")},
    ],
    ids=["kinds above", "splits anywhere", "splits above", "a class called train", "other names"],
)
def test_class_and_split_of_each_place(tree, tree_of) -> None:
    items = collect(tree(*tree_of))
    assert [item.id for item in items] == [name.removesuffix(".off") for name in sorted(tree_of)]
    assert {f"{i.id}.off": (i.class_name, i.split) for i in items} == tree_of


def test_ids_are_unique_and_do_not_depend_on_the_choice(tree) -> None:
    names = ["a/x.off", "a/x.obj", "a/x.obj.ply", "a/y.off", "b/x.off", "b/x.y.off", "b/x.y/z.off"]
    items = collect(tree(*names, "a/notes.txt", ".git/x.off"))
    ids = [item.id for item in items]
    assert ids == ["a/x.obj", "a/x.obj.ply", "a/x.off", "a/y", "b/x", "b/x.y", "b/x.y/z"]
    assert collect(tree(), classes=["b"]) == [item for item in items if item.class_name == "b"]


def test_links_are_followed_and_circles_are_left(tree, tmp_path: Path) -> None:
    root = tree("chair/a.off")
    disk = tmp_path / "disk"
    disk.mkdir()
    (disk / "b.off").write_text("")
    (root / "table").symlink_to(disk)
    (root / "chair/c.off").symlink_to(disk / "b.off")
    (root / "chair/again").symlink_to(root)
    (root / "chair/notes").symlink_to(root / "nowhere")
    assert [item.id for item in collect(root)] == ["chair/a", "chair/c", "table/b"]
    (root / "table/lost.off").symlink_to(root / "nowhere.off")
    with pytest.raises(InputError, match=r"lost.off: a link that leads to no file"):
        collect(root)


def test_a_folder_is_one_class_in_either_form_of_unicode(tree) -> None:
    """macOS hands out names decomposed, other systems as they were typed."""
    composed, decomposed = (unicodedata.normalize(form, "Sch\u00e4ft") for form in ("NFC", "NFD"))
    assert composed != decomposed
    items = collect(tree(f"{composed}/a.off", f"{decomposed}/b.off", "rod/c.off"))
    assert [item.class_name for item in items] == [composed, composed, "rod"]
    for name in (composed, decomposed):
        assert [item.class_name for item in collect(tree(), classes=[name])] == [composed] * 2


@pytest.mark.parametrize("name", ["chair/\udcff.off", "03001627/\udcff/model.obj"])
def test_a_name_that_no_table_can_hold_is_refused(tree, name) -> None:
    root = tree("03001627/a/model.obj" if name[0] == "0" else "chair/a.off")
    (root / name).parent.mkdir(exist_ok=True)
    (root / name).write_text("")
    with pytest.raises(InputError, match=r"rename '.*\\udcff.*', which is not UTF-8"):
        collect(root)


@pytest.mark.parametrize(
    ("names", "inner", "message"),
    [
        (["v2/03001627/a/models/model_normalized.obj"], "", "ShapeNet lies deeper; name .*root/v2"),
        (["03001627/a/model.obj"], "03001627", "one synset of ShapeNet; .* class chair"),
        (["M40/chair/train/a.off", "M40/readme.txt"], "", "ModelNet lies deeper; name .*root/M40"),
        (["night stand/a.off", "cup/b.off"], "night stand", "named as one class; name the folder"),
        (["cup/a.off", "cup/old/b.off"], "cup", "named as one class; name the folder"),
    ],
)
def test_the_wrong_level_is_refused(tree, names, inner, message) -> None:
    with pytest.raises(InputError, match=message):
        collect(tree(*names) / inner)


def test_a_file_beside_shapenet_makes_no_flat_folder(tree, caplog) -> None:
    found = collect(tree("03001627/a/model.obj", "cone.off"))
    assert {item.class_name for item in found} == {"chair", "cone"}
    assert "each file beside the folders is a class, named by its stem: cone.off" in caplog.text


@pytest.mark.parametrize("name", ["a.stl", "a.gltf"])
def test_a_mesh_that_changes_is_read_again_whatever_its_date(tmp_path, name):
    item = MeshItem("a", "a", "", tmp_path / name, None)
    for side in (1.0, 2.0, 3.0):
        content = trimesh.creation.box((side, side, side)).export(file_type=name[2:])
        files = content if isinstance(content, dict) else {name: content}
        for file, data in files.items():
            path = item.path if file == "model.gltf" else tmp_path / file
            path.write_bytes(data)
            os.utime(path, (0, 0))
        assert item.load().extents.tolist() == [side] * 3
