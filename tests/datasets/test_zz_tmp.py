"""A data set is read as it is by the libraries that people have."""

import dataclasses
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from qs3.datasets.generate import GenerateSettings, generate
from qs3.datasets.store import read_store

SETTINGS = GenerateSettings(num_points=16, rows_per_shard=4)
PAGE = Path("/work/main") / "docs" / "data.md"


@pytest.fixture(params=["float32", "float16"])
def made(request, fake, tmp_path):
    """Ten scans in three shards; ids, labels and points of them as our reader has them."""
    work = [fake.FakeItem(f"m{i}", ("chair", "sofa")[i % 2]) for i in range(10)]
    settings = dataclasses.replace(SETTINGS, dtype=request.param)
    folder = tmp_path / "set"
    generate(work, folder, settings, scan_one=fake.fake_row, workers=0, progress=False)
    return folder, read_store(folder)


def same(ours, ids, labels, clouds) -> None:
    assert list(ids) == list(ours.ids)
    assert list(labels) == ours.labels.tolist()
    rows = [np.asarray(cloud, dtype=np.float32).reshape(-1, 3) for cloud in clouds]
    np.testing.assert_array_equal(np.stack(rows), ours.points)


def test_pandas(made):
    pandas = pytest.importorskip("pandas")
    folder, ours = made
    frames = [pandas.read_parquet(path) for path in sorted(folder.glob("*.parquet"))]
    frame = pandas.concat(frames)
    same(ours, frame["id"], frame["label"], frame["points"])
    assert frame.groupby("class_name").size().to_dict() == {"chair": 5, "sofa": 5}


def test_polars(made):
    polars = pytest.importorskip("polars")
    folder, ours = made
    frame = polars.read_parquet(folder / "*.parquet")
    same(ours, frame["id"], frame["label"], frame["points"].to_list())
    lazy = polars.scan_parquet(folder / "*.parquet").filter(polars.col("class_name") == "sofa")
    assert lazy.select("id").collect()["id"].to_list() == list(ours.ids[1::2])


def test_duckdb(made):
    duckdb = pytest.importorskip("duckdb")
    folder, ours = made
    query = f"SELECT id, label, points FROM '{folder}/*.parquet' ORDER BY id"  # noqa: S608
    rows = duckdb.sql(query).fetchall()
    same(ours, *zip(*rows, strict=True))
    count = f"SELECT class_name, count(*) FROM '{folder}/*.parquet' GROUP BY ALL ORDER BY ALL"  # noqa: S608
    assert duckdb.sql(count).fetchall() == [("chair", 5), ("sofa", 5)]



def test_hugging_face_datasets(made, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    datasets = pytest.importorskip("datasets")
    folder, ours = made
    files = [str(path) for path in sorted(folder.glob("*.parquet"))]
    loaded = datasets.load_dataset(
        "parquet", data_files=files, split="train", cache_dir=str(tmp_path / "cache")
    )
    same(ours, loaded["id"], loaded["label"], loaded["points"])


def test_pyarrow(made):
    from pyarrow import dataset

    folder, ours = made
    table = dataset.dataset(sorted(map(str, folder.glob("*.parquet")))).to_table()
    same(ours, table["id"].to_pylist(), table["label"].to_pylist(), table["points"].to_pylist())


def test_sha256sum_checks_it(made):
    folder, _ = made
    command = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count(": OK") == 3


def test_the_page_about_data_works(made, monkeypatch):
    folder, ours = made
    for name in ("pandas", "polars", "duckdb"):
        pytest.importorskip(name)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 4
    monkeypatch.chdir(folder.parent)
    names: dict = {}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), names)  # noqa: S102
    assert names["clouds"].shape == ours.points.shape


def test_the_page_names_every_column(made):
    from pyarrow import parquet

    folder, _ = made
    text = PAGE.read_text(encoding="utf-8")
    columns = parquet.read_schema(folder / "shard-00000.parquet").names
    assert [name for name in columns if f"`{name}`" not in text] == []
