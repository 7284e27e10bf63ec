"""A data set is read as it is by the libraries that people have."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from qs3.io.layouts.store import read_ragged

PAGE = Path(__file__).parents[2] / "docs" / "data.md"


@dataclass(frozen=True)
class Made:
    """Ten scans in three shards, and what was handed to the writer."""

    folder: Path
    ids: list[str]
    labels: list[int]
    points: np.ndarray

    @property
    def files(self) -> list[str]:
        return sorted(map(str, self.folder.glob("*.parquet")))

    def equals(self, ids, labels, clouds) -> None:
        """Compare bit for bit."""
        assert list(ids) == self.ids
        assert list(labels) == self.labels
        rows = [np.asarray(cloud) for cloud in clouds]
        assert {row.dtype for row in rows} == {np.dtype(np.float32)}
        read = np.stack(rows).reshape(self.points.shape)
        np.testing.assert_array_equal(read.view(np.uint32), self.points.view(np.uint32))


@pytest.fixture
def made(fake, tmp_path):
    work = [fake.mesh(f"m{i}", ("chair", "sofa")[i % 2]) for i in range(10)]
    folder = tmp_path / "set"
    fake.run(work, folder)
    rows = [fake.fake_row(item, 0, fake.SETTINGS) for item in work]
    points = np.stack([row.points for row in rows])
    return Made(folder, [row.id for row in rows], [row.label for row in rows], points)


def test_our_reader(made):
    ours = read_ragged(made.folder)
    made.equals(ours.ids, ours.labels, np.stack(ours.clouds))
    assert ours.clouds[0].dtype == np.float32


def test_pandas(made):
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(made.files)
    made.equals(frame["id"], frame["label"], frame["points"])
    assert frame["points"][0].dtype == made.points.dtype
    assert frame.groupby("class_name").size().to_dict() == {"chair": 5, "sofa": 5}


def test_pyarrow(made):
    from pyarrow import dataset

    table = dataset.dataset(made.files).to_table()
    clouds = [row.values.to_numpy(zero_copy_only=False) for row in table["points"]]
    made.equals(table["id"].to_pylist(), table["label"].to_pylist(), clouds)
    assert clouds[0].dtype == made.points.dtype


def test_the_page_about_data_works(made, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    for name in ("pandas", "polars", "duckdb", "datasets"):
        pytest.importorskip(name)
    # Its cache was fixed when it was first imported.
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path / "cache")
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 6
    monkeypatch.chdir(made.folder.parent)
    names: dict = {}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), names)  # noqa: S102
    assert names["clouds"].shape == made.points.shape


def test_the_page_names_every_column_and_file(made):
    from pyarrow import parquet

    text = PAGE.read_text(encoding="utf-8")
    columns = parquet.read_schema(made.folder / "shard-00000.parquet").names
    names = [*columns, "shard-00000.parquet", "dataset.json", "meshes.json", "failures.jsonl"]
    assert [name for name in names if f"`{name}`" not in text] == []
