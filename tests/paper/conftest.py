"""A grid so small that it takes seconds: blobs in place of scans, narrow networks."""

import json
import os
import shutil
import warnings

import numpy as np
import pytest

from qs3.evaluation.records import RECORDS, read_records
from qs3.paper.cells import Cell, data_sets_of
from qs3.paper.domains import folder_of_data
from qs3.paper.galleries import shown
from qs3.paper.prepare import choose_meshes, make_plans
from qs3.paper.reproduce import choose_tables, collect_cells, reproduce
from qs3.paper.scales import SCALES, Scale
from qs3.paper.setup import Setup, claim
from qs3.runs.settings import TrainSettings
from qs3.store.generate import generate, scan_seed
from qs3.store.shards import CloudRow
from qs3.structure import unstructure

TINY = Scale(
    name="smoke",
    source_per_class=3,
    target_per_class=2,
    test_per_class=2,
    common_factor=2,
    source_views=1,
    data_points=64,
    train=TrainSettings(
        model="pointnet",
        model_settings={"channels": (8, 8, 16), "hidden": (8,), "transforms": False},
        num_points=32,
        epochs=4,
        learning_rate=2e-2,
        batch_size=16,
        validate_every=1,
        accelerator="cpu",
    ),
    rounds={"threshold": 0.0, "rounds": 2, "epochs": 1},
    networks={"dgcnn": {"neighbours": 4, "channels": (8, 8), "embedding": 16, "hidden": (8,)}},
    fused_views=(1, 2),
    thetas=(0.0, 0.2),
    steps=(0.1,),
    sensors=("paper", "d435"),
)


def blob_row(item, scan, settings, neighbours=()):
    """A cloud whose proportions tell its class; the target's are noisier."""
    seed = scan_seed(settings.seed, item.id, scan)
    rng = np.random.default_rng(seed)
    label = settings.classes.index(item.class_name)
    shape = np.random.default_rng(label).uniform(0.1, 1, 3)
    n = settings.num_points
    clouds = {
        name: (rng.normal(size=(n, 3)) * shape + noise * rng.normal(size=(n, 3))).astype("float32")
        for name, noise in (("points", 0.1), ("clean", 0.0), ("surface", 0.0))
    }
    return CloudRow(
        id=f"{item.id}#{scan}",
        object=item.id,
        scan=scan,
        label=label,
        class_name=item.class_name,
        split=item.split,
        seed=seed,
        view=np.zeros(n, np.uint8),
        clean_view=np.zeros(n, np.uint8),
        yaw=0.0,
        valid_fraction=1.0,
        **clouds,
    )


def make_tables(
    out,
    names,
    rows=(),
    columns=(),
    seeds=(0, 1),
    report=lambda line: None,
    galleries=False,
    scale=TINY,
    **changes,
):
    """Reproduce some tables at the tiny scale; blobs stand for the scans."""
    setup = Setup(out, scale, seeds=seeds, threads=1, meshes="shapes", **changes)
    tables = choose_tables(names, setup, rows, columns)
    sets = [*data_sets_of(collect_cells(tables), setup), *(shown(setup) if galleries else [])]
    claim(setup)
    for data, plan in make_plans(TINY, choose_meshes(TINY, None), sets).items():
        folder = out / "data" / folder_of_data(data)
        if not folder.exists():
            options = {"scan_one": blob_row, "workers": 0, "progress": False}
            generate(plan.items, folder, plan.settings, **options)
    with warnings.catch_warnings():  # so small a network may be sure of one class alone, or of none
        warnings.simplefilter("ignore")
        return reproduce(tables, setup, report, galleries=galleries)


def records_of(folder):
    """Records by the name of their run, in the order of the lines."""
    path = folder / RECORDS
    found, faults = read_records(path) if path.is_file() else ([], [])
    assert faults == []
    return {Cell(**record.experiment).name: record for _, record in found}


def rewrite(folder, change):
    """Write the records again: each as ``change`` returns its JSON value, or without it (None)."""
    lines = []
    for name, record in records_of(folder).items():
        value = change(name, unstructure(record))
        lines += [] if value is None else [json.dumps(value) + "\n"]
    (folder / RECORDS).write_text("".join(lines))


def drop(folder, *names):
    """Delete records by the names of their runs."""
    rewrite(folder, lambda name, value: None if name in names else value)


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Some tables, made once: of networks, of QBST as the paper has it, of the bench."""
    out = tmp_path_factory.mktemp("experiments") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("QS3_SHARED_DATA", raising=False)
        make_tables(out, ["ordinary"], columns=("M-D", "S-D", "S-F"))
        make_tables(out, ["thresholds"], seeds=(0,))
        rows = ("supervised", "ordinary", "qbst")
        make_tables(out, ["uda"], rows, ("S-D",), seeds=(0,))
    return out


@pytest.fixture
def finished(whole, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(whole, tmp_path / "copy")


@pytest.fixture
def small_scales(monkeypatch):
    monkeypatch.setitem(SCALES, "smoke", TINY)
    monkeypatch.delitem(os.environ, "QS3_SHARED_DATA", raising=False)
