import pytest

from qs3.clouds.layouts import formats
from qs3.clouds.load import detect, format_named
from qs3.errors import InputError


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


@pytest.mark.parametrize(
    ("files", "name"),
    [
        (["chair/train/a.ply", "chair/test/b.ply", "readme.md"], "folder"),
        (["a.pcd", "b.pcd", "labels.csv"], "folder"),
        (["train/chair/a.npy"], "folder"),
        (["chair/a.xyz", "chair/a.PLY", ".hidden.ply"], "folder"),
        (["dataset.json", "shard-00000.parquet"], "store"),
        (["modelnet/bed/train/a.npy"], "pointda10"),
        (["scannet/train_0.h5", "scannet/test_0.h5"], "pointda10"),
        (["airplane/train/a.off", "airplane/test/b.off"], "folder"),
        (["bed/bed_0001.txt", "modelnet40_train.txt", "modelnet40_test.txt"], "modelnet-normal"),
        (["ply_data_train0.h5", "shape_names.txt", "train_files.txt"], "h5"),
        (["training_objectdataset.h5", "test_objectdataset.h5"], "h5"),
    ],
)
def test_a_layout_is_known_by_names_alone(tmp_path, files, name):
    # The files are empty: nothing in them is looked at.
    assert detect(touch(tmp_path, *files)).name == name


def test_an_archive_is_known_by_its_ending(tmp_path):
    assert detect(touch(tmp_path, "a.npz") / "a.npz").name == "npz"


def test_no_layout_lists_them_all(tmp_path):
    with pytest.raises(InputError) as caught:
        detect(touch(tmp_path, "letter.docx"))
    assert "\n" not in str(caught.value)
    for layout in formats().values():
        assert f"{layout.name}: {layout.layout}" in str(caught.value)


def test_several_layouts_are_told_with_the_option_that_chooses(tmp_path):
    touch(tmp_path, "dataset.json", "ply_data_train0.h5")
    with pytest.raises(InputError, match=r"several layouts.*--from store: .*--from h5: "):
        detect(tmp_path)


def test_a_missing_or_empty_path_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: no such file or folder$"):
        detect(tmp_path / "nowhere", "ply")
    with pytest.raises(InputError, match=r"an empty folder$"):
        detect(tmp_path)


def test_an_unknown_name_lists_all_and_the_nearest():
    with pytest.raises(InputError, match=r"'pointda' is no known layout.*mean pointda10") as e:
        format_named("pointda")
    assert all(name in str(e.value) for name in formats())
    assert format_named("ply").name == "ply"


def test_detection_survives_whatever_it_is_shown(tmp_path):
    touch(tmp_path, "file", "folder/x")
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "dangling").symlink_to(tmp_path / "gone")
    for layout in formats().values():
        for name in ("file", "folder", "loop", "dangling", "gone", ""):
            assert layout.detect(tmp_path / name) in (True, False)
