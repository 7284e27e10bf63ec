"""``qs3 extract scannet`` on a rendered room."""

import pytest

from qs3.cli import main
from qs3.io.layouts.contents import open_dataset, read_ragged

from .writers import write_room


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "scans"
    write_room(folder)
    return folder


def runs(*arguments):
    with pytest.raises(SystemExit) as caught:
        main(["extract", "scannet", *map(str, arguments)])
    assert caught.value.code == 0


@pytest.mark.parametrize("more", [(), ("--from-mesh",)])
def test_both_ways_give_the_rooms_objects_with_their_split(scans, tmp_path, capsys, more):
    (tmp_path / "train.txt").write_text("scene0000_00\n")
    runs(scans, "--out", tmp_path / "out", "--splits-train", tmp_path / "train.txt", "--every", 1,
         "--min-pixels", 30, "--min-points", 100, "--num-points", 256, "--workers", 0,
         *more)  # fmt: skip
    found = read_ragged(tmp_path / "out")
    assert {found.class_names[label] for label in found.labels} == {"chair", "table"}
    assert set(found.splits) == {"train"}
    assert {len(cloud) for cloud in found.clouds} == {256}
    assert open_dataset(tmp_path / "out").settings["from_mesh"] is bool(more)
    told = capsys.readouterr()
    assert told.out.strip() == str(tmp_path / "out")
    assert "2 objects" in told.err
