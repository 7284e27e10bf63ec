import json
import shutil

import pytest

from qs3 import shapes
from qs3.clouds.load import load_clouds
from qs3.meshes.classes import POINTDA10


@pytest.fixture
def few(small):
    """The flags of a data set of four scans in two shards."""
    return ("--classes", "chair", "sofa", "--per-class", 2, "--rows-per-shard", 2,
            "--num-points", 64, "--meshes", "shapes", "--workers", 0, *small)  # fmt: skip


@pytest.fixture
def cad(tmp_path):
    """A folder of three meshes, of which one is broken."""
    for name in ("chair", "sofa"):
        (tmp_path / "cad" / name).mkdir(parents=True)
        shapes.make(name, 0).export(tmp_path / "cad" / name / "one.ply")
    (tmp_path / "cad" / "sofa" / "two.off").write_text("OFF\n0 0 0\n")
    return tmp_path / "cad"


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_dry_run_counts_writes_nothing_and_needs_no_folder(typed, few, tmp_path):
    typed("generate", *few, "--out", tmp_path / "out", "--dry-run")
    assert not (tmp_path / "out").exists()
    done = typed("generate", *few, "--scans-per-mesh", 3, "--dry-run")
    assert "chair: 2 objects" in done.stdout
    assert "12 scans in 6 shards" in done.stdout
    done = typed("generate", *few, "--scans-per-mesh", 3, "--shard", "1/4", "--dry-run")
    assert "part 1/4: 4 scans in 2 shards" in done.stdout
    assert "--out: name the folder" in typed.refuses("generate", *few)


def test_a_dry_run_refuses_what_the_run_refuses(typed, few, tmp_path):
    typed("generate", *few, "--out", tmp_path / "out")
    before = content(tmp_path / "out")
    typed("generate", *few, "--out", tmp_path / "out", "--dry-run")
    for dry in ((), ("--dry-run",)):
        line = typed.refuses("generate", *few, "--out", tmp_path / "out", "--seed", 7, *dry)
        assert "out: made with seed = " in line
    assert content(tmp_path / "out") == before


def test_a_data_set_has_the_classes_of_its_meshes_and_the_ten_on_request(typed, small, tmp_path):
    for name in ("chair", "desk"):
        (tmp_path / "cad" / name).mkdir(parents=True)
        shapes.make("chair" if name == "chair" else "table", 0).export(
            tmp_path / "cad" / name / "one.ply"
        )
    flags = ("--num-points", 64, "--workers", 0, *small)

    def names(*words):
        out = tmp_path / f"out{len(words)}"
        typed("generate", *words, *flags, "--out", out)
        return load_clouds(out, num_points=None).class_names

    assert names("--meshes", tmp_path / "cad") == ("chair", "desk")
    ten = names("--meshes", tmp_path / "cad", "--classes", "pointda10")
    assert ten == POINTDA10
    built_in = ("--meshes", "shapes", "--classes", "table", "chair", "--per-class", 1)
    assert names(*built_in) == ("chair", "table")


def test_parts_merge_into_a_sound_data_set(typed, few, tmp_path):
    for part in range(2):
        typed("generate", *few, "--out", tmp_path / f"part{part}", "--shard", f"{part}/2")
    typed("merge", tmp_path / "part0", tmp_path / "part1", "--out", tmp_path / "merged")
    typed("info", "--check", tmp_path / "merged")
    shards = {path.name for path in (tmp_path / "merged").glob("*.parquet")}
    assert shards == {path.name for path in tmp_path.glob("part*/*.parquet")}


def test_a_mended_mesh_is_scanned_again_and_a_changed_one_refused(typed, small, cad, tmp_path):
    flags = ("--meshes", cad, "--num-points", 64, "--workers", 0, *small)
    here = (*flags, "--out", tmp_path / "out")
    done = typed("generate", *here, code=2)
    assert "1 scans failed; the first: sofa/two#0" in done.stderr
    shapes.make("sofa", 1).export(cad / "sofa" / "two.off")
    done = typed("generate", *here, "--retry-failed")
    assert "1 scans written, 2 were there before, 0 failed" in done.stderr
    typed("generate", *flags, "--out", tmp_path / "new")
    assert content(tmp_path / "out") == content(tmp_path / "new")
    shapes.make("chair", 1).export(cad / "chair" / "one.ply")
    line = typed.refuses("generate", *here)
    assert "chair/one: the mesh has changed since it was scanned" in line


def test_info_counts_and_its_check_finds_damage(typed, store, tmp_path):
    done = typed("info", store)
    assert "10 clouds of 10 planned, of 10 objects" in done.stdout
    assert "128 points per cloud" in done.stdout
    contents = json.loads(typed("info", store, "--json").stdout)
    assert contents["rows"] == 10
    assert contents["settings"]["seed"] == 5
    assert "10 clouds" in typed("info", store, "--check").stdout
    shutil.copytree(store, tmp_path / "copy")
    shard = tmp_path / "copy" / "shard-00000.parquet"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(bytes(data))
    done = typed("info", "--check", tmp_path / "copy", code=2)
    assert "shard-00000.parquet: cannot be read as Parquet" in done.stdout
    assert "1 faults, printed above" in done.stderr
    assert "not a qs3 data set" in typed.refuses("info", "--check", tmp_path)
    (tmp_path / "none").mkdir()
    assert "an empty folder" in typed.refuses("info", tmp_path / "none")


def test_shapes_and_meshes_go_into_one_data_set(typed, small, cad, tmp_path):
    (cad / "sofa" / "two.off").unlink()
    (tmp_path / "map.toml").write_text('sofa = "seat"\nmug = "cup"\n')
    done = typed("generate", "--meshes", cad, "shapes", "--per-class", 1, "--classes", "chair",
        "sofa", "--map", tmp_path / "map.toml", "--out", tmp_path / "out", "--num-points", 64,
        "--workers", 0, *small)  # fmt: skip
    assert "classes: sofa → seat\nclasses: none here is mug, as the map has it" in done.stderr
    contents = json.loads(typed("info", tmp_path / "out", "--json").stdout)
    assert contents["classes"] == {"chair": 2, "seat": 2}
    assert contents["renamed"] == {"sofa": "seat"}
    assert contents["settings"]["meshes"] == "cad+shapes"


def test_labels_in_a_csv_and_the_ten_classes(typed, small, tmp_path):
    flat = tmp_path / "flat"
    flat.mkdir()
    for index, name in enumerate(("chair", "table", "cabinet")):
        shapes.make(name, index).export(flat / f"{name}.glb")
    flags = ("--meshes", flat, "--out", tmp_path / "out", "--num-points", 64, "--workers", 0,
             *small)  # fmt: skip
    rows = ["uid,category,split", "chair,Arm Chair,train", "table,desk,test", "cabinet,toilet,test"]
    (tmp_path / "labels.csv").write_text("\n".join(rows) + "\n")
    named = (*flags, "--labels", tmp_path / "labels.csv")
    typed("generate", *named, "--classes", "pointda10")
    contents = json.loads(typed("info", tmp_path / "out", "--json").stdout)
    assert {name: n for name, n in contents["classes"].items() if n} == {"chair": 1, "table": 1}
    assert contents["splits"] == {"test": 1, "train": 1}
