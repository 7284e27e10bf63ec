"""Exported networks, run by onnxruntime and by torch.export, against ours."""

import json
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.errors import TOLD, InputError, MissingExtraError, QS3Error
from qs3.io.preparation import PAPER, ROBUST, distinct_inliers, normalise, resample
from qs3.models import create_model
from qs3.models.aligned import Aligned
from qs3.models.ops import farthest_point_sampling
from qs3.models.ops.sampling import sample_in_a_loop
from qs3.models.sized import Sized
from qs3.training import TrainSettings, export, load_model, predict_probabilities, save_model
from qs3.training.export import compare, export_run, subsample_in_a_graph
from qs3.training.prepared import normalise_in_a_graph, note_size

from ..models.common import SMALL

OWN = replace(ROBUST, size_input=True, align=True)
CLASSES = ("Stuhl", "テーブル", 'a "lamp"')
TINY = "pointnet of each point"
M = 40
SIZES = [1, 2, M - 1, M, M + 1, 3 * M]


def make_run(folder, name=TINY, num_points=M, preparation=PAPER):
    """A run whose network has moved statistics and decided answers."""
    torch.manual_seed(3)
    kind = name.split()[0]
    model = create_model(kind, len(CLASSES), **SMALL[name])
    for layer in model.modules():
        if isinstance(layer, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            torch.nn.init.uniform_(layer.weight, 0.3, 1)
    for _ in range(3):
        model(0.5 * torch.randn(8, num_points, 3))
    with torch.no_grad():
        list(model.parameters())[-2].mul_(8)
    if preparation.align:
        model = Aligned(model)
    if preparation.size_input:
        model = Sized(model, preparation.radius_share)
        torch.nn.init.normal_(model.size[2].weight)
    settings = TrainSettings(
        model=kind, model_settings=SMALL[name], num_points=num_points, preparation=preparation
    )
    save_model(folder, model.eval(), CLASSES, settings)
    return model


def clouds(b, n, seed=0):
    """Flat boxes far from the origin, in millimetres."""
    rng = np.random.default_rng(seed)
    return (1000 * rng.normal(size=(b, n, 3)) * [1, 0.5, 0.1] + 30_000).astype(np.float32)


def run_onnx(path):
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda points: session.run(["probabilities"], {"points": points})[0]


def run_program(path):
    module = torch.export.load(path).module()
    return lambda points: module(torch.from_numpy(points)).numpy()


def check(model, run):
    for n in SIZES:
        for b in (1, 3):
            points = clouds(b, n, seed=n)
            wanted = predict_probabilities(model, points, num_points=M)
            got = run(points)
            assert (got.dtype, got.shape) == (np.float32, wanted.shape)
            np.testing.assert_allclose(got, wanted, rtol=0, atol=2e-5)


def resampled(points):
    return np.stack([resample(cloud, M) for cloud in points]).astype(np.float64)


@pytest.mark.parametrize("n", SIZES)
def test_subsampling_in_a_graph_takes_the_same_points(n):
    points = clouds(3, n)
    got = subsample_in_a_graph(torch.from_numpy(points).double(), M)
    assert np.array_equal(got.numpy(), resampled(points))


def test_subsampling_in_a_graph_breaks_ties_and_repeats_points_alike():
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), axis=-1).reshape(1, -1, 3)
    few = np.repeat(grid[:, :7], 20, axis=1)
    for points in (grid.astype(np.float32), few.astype(np.float32)):
        got = subsample_in_a_graph(torch.from_numpy(points).double(), M)
        assert np.array_equal(got.numpy(), resampled(points))


@pytest.mark.parametrize("n", [50, 51])
@pytest.mark.parametrize("preparation", [PAPER, ROBUST, OWN])
def test_normalise_in_a_graph_is_that_of_training(preparation, n):
    points = clouds(4, n)
    got = normalise_in_a_graph(torch.from_numpy(points).double(), preparation).float().numpy()
    wanted = normalise(points, preparation)
    np.testing.assert_allclose(got, wanted, rtol=2e-7, atol=1e-7)
    same = torch.full((1, 7, 3), 0.1, dtype=torch.float64)
    assert torch.equal(normalise_in_a_graph(same), torch.zeros(1, 7, 3, dtype=torch.float64))


@pytest.mark.parametrize("m", [1, 9, 40])
def test_loop_for_graphs_samples_as_networks_do(m):
    points = torch.randn(3, 40, 3, generator=torch.Generator().manual_seed(0))
    points[:, 20:] = points[:, :20]
    start = torch.tensor([0, 7, 39])
    chosen = start[:, None].expand(-1, m).clone()
    planes = points.permute(2, 0, 1).contiguous()
    got = sample_in_a_loop(planes, chosen, torch.tensor(m))
    assert torch.equal(got, farthest_point_sampling(points, m, start))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    model = make_run(folder)
    return model, {to: export_run(folder, to) for to in export.SUFFIXES}


def test_exports_give_our_probabilities_of_clouds_of_any_size(exported):
    check(exported[0], run_onnx(exported[1]["onnx"].path))
    check(exported[0], run_program(exported[1]["torch-export"].path))


def test_an_export_takes_what_prediction_hands_the_network(tmp_path):
    """Size in metres, a robust ball; strays are the caller's to remove, and the file says so."""
    import onnx

    model = make_run(tmp_path, preparation=OWN)
    path = export_run(tmp_path, "onnx").path
    run = run_onnx(path)
    facts = json.loads({p.key: p.value for p in onnx.load(path).metadata_props}["qs3"])
    assert facts["expects"] == {"distinct": True, "outliers_removed": True, "most": 4096}
    assert facts["settings"]["train"]["preparation"]["radius_share"] == 0.95
    answers = []
    for n in (M - 9, 3 * M):
        points = clouds(3, n, seed=n) / 1000
        points[:, 5] += 50
        wanted = predict_probabilities(load_model(tmp_path), points)
        for cloud, shares in zip(points, wanted, strict=True):
            kept = cloud[distinct_inliers(cloud, True)]
            assert len(kept) < n
            np.testing.assert_allclose(run(kept[None])[0], shares, rtol=0, atol=2e-5)
            answers.append(np.abs(run(16 * kept[None])[0] - shares).max())
    assert max(answers) > 1e-3  # sixteen times as large is another thing
    assert model.share == 0.95


def test_exports_tell_what_they_hold(exported):
    import onnx

    model = onnx.load(exported[1]["onnx"].path)
    facts = json.loads({p.key: p.value for p in model.metadata_props}["qs3"])
    assert facts["class_names"] == list(CLASSES)
    assert facts["settings"]["train"]["num_points"] == M
    dims = model.graph.input[0].type.tensor_type.shape.dim
    assert [d.dim_param or d.dim_value for d in dims] == ["clouds", "points", 3]
    extra = {"qs3": ""}
    torch.export.load(exported[1]["torch-export"].path, extra_files=extra)
    assert json.loads(extra["qs3"]) == facts


def test_program_holds_nothing_pickled(exported):
    with zipfile.ZipFile(exported[1]["torch-export"].path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    configs = [data for name, data in parts.items() if name.endswith("_config.json")]
    assert len(configs) == 2
    entries = [entry for data in configs for entry in json.loads(data)["config"].values()]
    assert entries
    assert not any(entry["use_pickle"] for entry in entries)
    # Numbers may begin with any byte: of a tensor, that it is its numbers and nothing else.
    for entry in entries:
        meta = entry["tensor_meta"]
        count = int(np.prod([size["as_int"] for size in meta["sizes"]]))
        data = parts.pop(f"archive/data/weights/{entry['path_name']}")
        assert len(data) == count * {5: 8, 7: 4}[meta["dtype"]]  # int64, float32
        assert not data.startswith((b"PK\3\4", *(bytes([128, p]) for p in range(2, 6))))
    assert not any(data.startswith((b"PK", b"\x80")) for data in parts.values())


@pytest.mark.slow
def test_program_runs_without_qs3(exported):
    code = (
        "import sys, torch; sys.modules['qs3'] = None\n"
        f"module = torch.export.load({str(exported[1]['torch-export'].path)!r}).module()\n"
        "print(module(torch.randn(2, 90, 3)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == f"torch.Size([2, {len(CLASSES)}])", done.stderr


@pytest.mark.parametrize("to", [pytest.param("onnx", marks=pytest.mark.slow), "torch-export"])
@pytest.mark.parametrize("name", sorted(set(SMALL) - {TINY}))
def test_every_network_can_be_exported(name, to, tmp_path):
    model = make_run(tmp_path, name)
    # In its own process: the tests' check of types takes no symbol for an int.
    command = [sys.executable, "-m", "qs3", "export", str(tmp_path), "--to", to]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    path = tmp_path / f"model{export.SUFFIXES[to]}"
    check(model, run_onnx(path) if to == "onnx" else run_program(path))


def test_comparison_sees_a_wrong_answer():
    torch.manual_seed(0)
    model = create_model("pointnet", 3, **SMALL[TINY]).eval()

    def right(points):
        return predict_probabilities(model, points, num_points=M)

    assert compare(model, M, right).tolist() == [0.0] * 28
    shifted = compare(model, M, lambda points: right(points) + 1e-3)
    np.testing.assert_allclose(shifted, 1e-3, rtol=0, atol=1e-12)
    assert (compare(model, M, lambda points: right(points) * np.nan) == np.inf).all()
    assert (compare(model, M, lambda points: right(points)[:, :2]) == np.inf).all()
    # Subsampled from another point, only clouds of more than M points give other answers.
    other = compare(model, M, lambda points: right(points[:, ::-1])) > export.ROUNDING
    assert export.STRAYS[0] < other.sum() <= 8


def test_sizes_of_its_own_clouds_are_not_told(caplog):
    TOLD.clear()
    torch.manual_seed(0)
    model = Sized(create_model("pointnet", 3, **SMALL[TINY]), OWN.radius_share).eval()
    compare(model, M, lambda points: np.zeros((len(points), 3)), replace(OWN, align=False))
    assert not caplog.messages
    note_size(clouds(4, 50) * 1e4, OWN)
    assert "larger than 20 m" in caplog.text


def test_comparison_goes_the_whole_way_of_raw_clouds(monkeypatch):
    """Strays and repeated points go before the file, and an export that misses it is seen."""
    torch.manual_seed(0)
    model = create_model("pointnet", 3, **SMALL[TINY]).eval()
    inside = replace(ROBUST, remove_outliers=False, redraw=False)

    def runner(points):
        return predict_probabilities(model, points, num_points=M, preparation=inside)

    assert compare(model, M, runner, ROBUST).max() <= export.ROUNDING
    monkeypatch.setattr(export, "distinct_inliers", lambda cloud, *_: np.arange(len(cloud)))
    strayed = compare(model, M, runner, ROBUST)
    assert len(strayed) == 28
    assert (strayed > 1e-3).sum() >= 4


def test_nothing_is_written_where_answers_differ(tmp_path, monkeypatch):
    make_run(tmp_path)
    wrong = (b"file", lambda points: np.full((len(points), 3), 1 / 3))
    monkeypatch.setattr(export, "_serialise", lambda *_: wrong)
    with pytest.raises(QS3Error, match=r"model.pt2: not written: on \d+ of 28 .*not the source"):
        export_run(tmp_path, "torch-export")
    assert not (tmp_path / "model.pt2").exists()


def test_earlier_exports_are_replaced_and_other_files_kept(exported, tmp_path, monkeypatch):
    model = make_run(tmp_path)

    def fresh(points):
        return predict_probabilities(model, points, num_points=M)

    monkeypatch.setattr(export, "_serialise", lambda *_: (b"new", fresh))
    for to, suffix in export.SUFFIXES.items():
        ours, other = tmp_path / f"ours{suffix}", tmp_path / f"other{suffix}"
        ours.write_bytes(exported[1][to].path.read_bytes())
        export_run(tmp_path, to, ours)
        assert ours.read_bytes() == b"new"
        other.write_bytes(b"precious")
        with pytest.raises(InputError, match=f"other{suffix}: holds something else"):
            export_run(tmp_path, to, other)
        assert other.read_bytes() == b"precious"


def test_unusable_places_and_runs_are_refused(tmp_path):
    make_run(tmp_path)
    (tmp_path / "folder.onnx").mkdir()
    faults = [
        ((tmp_path / "none", "onnx"), "no model.safetensors here"),
        ((tmp_path, "tflite"), "choose one of onnx, torch-export"),
        ((tmp_path, "onnx", tmp_path / "a.pt2"), "ends in .onnx"),
        ((tmp_path, "onnx", tmp_path / "folder.onnx"), "is a folder"),
    ]
    for arguments, message in faults:
        with pytest.raises(InputError, match=message):
            export_run(*arguments)
    (tmp_path / "settings.json").write_text('{"train": {}}')
    with pytest.raises(InputError, match="is missing"):
        export_run(tmp_path, "onnx")


@pytest.mark.parametrize("package", ["onnx", "onnxscript", "onnxruntime"])
def test_a_missing_package_names_its_extra(package, tmp_path, monkeypatch):
    make_run(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=f"{package}.*'export'"):
        export_run(tmp_path, "onnx")


def test_a_network_that_cannot_be_exported_is_named(tmp_path, monkeypatch):
    make_run(tmp_path)

    def fails(*_, **__):
        raise RuntimeError("no way\nto export")

    monkeypatch.setattr(torch.export, "export", fails)
    with pytest.raises(QS3Error, match=r"PointNet cannot be exported to torch-export.*no way to"):
        export_run(tmp_path, "torch-export")
