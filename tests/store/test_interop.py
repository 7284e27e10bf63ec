"""A data set is read as it is by the libraries that people have."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "data.md"


@pytest.fixture
def dataset(fake, tmp_path):
    """A folder of ten scans in three shards, and their noisy points."""
    work = [fake.mesh(f"m{i}", ("chair", "sofa")[i % 2]) for i in range(10)]
    fake.run(work, tmp_path / "set")
    rows = [fake.fake_row(item, 0, fake.SETTINGS) for item in work]
    return tmp_path / "set", np.stack([row.points for row in rows])


def test_the_page_about_data_works(dataset, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    for name in ("pandas", "polars", "duckdb", "datasets"):
        pytest.importorskip(name)
    # Its cache was fixed when it was first imported.
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path / "cache")
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 6
    folder, points = dataset
    monkeypatch.chdir(folder.parent)
    names: dict = {}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), names)  # noqa: S102
    np.testing.assert_array_equal(names["clouds"].view(np.uint32), points.view(np.uint32))


def test_the_page_names_every_column_and_file(dataset):
    from pyarrow import parquet

    text = PAGE.read_text(encoding="utf-8")
    columns = parquet.read_schema(dataset[0] / "shard-00000.parquet").names
    names = [*columns, "shard-00000.parquet", "dataset.json", "meshes.json", "failures.jsonl"]
    assert [name for name in names if f"`{name}`" not in text] == []
