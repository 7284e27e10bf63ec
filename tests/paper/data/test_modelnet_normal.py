"""ModelNet40's clouds with normals: lists beside class folders, y up."""

import numpy as np

from qs3.answers.cloud_files import list_clouds, read_listed
from qs3.clouds.load import load_clouds

from ...clouds.hostile import refused


def test_clouds_are_turned_z_up_and_split_by_the_lists(tmp_path, rng):
    names = {"train": ["bed_0001", "night_stand_0001"], "test": ["bed_0002"]}
    stored = {}
    for split, listed in names.items():
        (tmp_path / f"modelnet40_{split}.txt").write_text("\n".join(listed) + "\n")
        for name in listed:
            rows = stored[name] = rng.random((60, 6)).astype(np.float32)
            folder = tmp_path / name.rpartition("_")[0]
            folder.mkdir(exist_ok=True)
            lines = (",".join(f"{value:.6f}" for value in row) for row in rows)
            (folder / f"{name}.txt").write_text("\n".join(lines))
    for name in ("modelnet40_shape_names.txt", "filelist.txt"):
        (tmp_path / name).write_text("bed\nnight_stand\n")
    for split, listed in names.items():
        clouds = load_clouds(tmp_path, split=split, num_points=None)
        assert [id.rpartition("/")[2] for id in clouds.ids] == [f"{name}.txt" for name in listed]
        for name, label, cloud in zip(listed, clouds.labels, clouds.points, strict=True):
            assert clouds.class_names[label] == name.rpartition("_")[0]
            x, y, z = stored[name][:, :3].T
            np.testing.assert_allclose(cloud, np.stack([x, -z, y], axis=1), atol=1e-6)
    # Not file by file, which would leave y up.
    assert list_clouds([tmp_path]) == [tmp_path]
    assert len(read_listed(tmp_path)) == 3
    for name in ("x" * 300 + "_1", "bed_" + "1" * 300, "../up_1"):
        (tmp_path / "modelnet40_test.txt").write_text(name)
        with refused("a path, too long|no such file", tmp_path):
            load_clouds(tmp_path)
    (tmp_path / "modelnet40_test.txt").write_text("bed_0002")
    (tmp_path / "bed" / "bed_0002.txt").unlink()
    with refused("bed_0002.txt, and there is no such file", tmp_path):
        load_clouds(tmp_path)
