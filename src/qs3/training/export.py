"""A trained network with its pre-processing inside, as ONNX or as a program of torch.export."""

import contextlib
import io
import json
import logging
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import InputError, MissingExtraError, QS3Error, no_such, unsaid
from qs3.files import write_bytes
from qs3.io.preparation import LARGEST, PAPER, Preparation, distinct_inliers
from qs3.models import PointClassifier
from qs3.models.ops.sampling import sample_in_a_loop
from qs3.training.checkpoint import load_model
from qs3.training.predict import predict_probabilities
from qs3.training.prepared import normalise_in_a_graph
from qs3.training.shipped import workplace

SUFFIXES: Mapping[str, str] = {"onnx": ".onnx", "torch-export": ".pt2"}
"""The formats, and how the names of their files end."""

KEY = "qs3"
"""Name of the metadata: a property of an ONNX file, ``extra/qs3`` in a program's archive."""

ROUNDING = 1e-5
"""Largest difference of a probability that rounding alone explains."""

STRAYS = (2, 1e-2)
"""How many clouds of the verification may differ by more, and by how much at most: where two points
are equally far from a third but for rounding, another neighbour is chosen."""

_AXES = {0: "clouds", 1: "points"}
"""Axes of the input that may have any size."""

_Runner = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Exported:
    """What an export gave."""

    path: Path
    """The file."""
    difference: float
    """Largest difference of a probability from the source's, over the clouds of verification."""
    strays: int
    """Number of those clouds that differ by more than rounding."""
    clouds: int
    """Number of those clouds in all."""
    seconds: float
    """Time of the export, without verification."""
    expects: Mapping[str, Any]
    """What `qs3.io.preparation.distinct_inliers` is to do to a cloud before: its ``most`` and
    whether ``outliers_removed``; ``distinct`` is false where nothing is to be done."""


class CloudClassifier(nn.Module):
    """A network that takes clouds of any size in any unit, and gives probabilities.

    Inside are the steps of `qs3.training.prepared.prepare_clouds`, in double precision as there:
    clouds of more than ``num_points`` points are subsampled from point 0 on, points of
    smaller ones are repeated in order; then they are normalised. Outliers and points that repeat
    others must be gone before (`distinct_inliers`).

    Convention:
        Points are [b n 3], finite, z up; all clouds of a batch have the same n.

    Args:
        model: The network.
        num_points: Points a cloud that it was trained on.
        preparation: What was done to them.

    Example:
        >>> from qs3.models import create_model
        >>> network = CloudClassifier(create_model("pointnet", 4), 16).eval()
        >>> network(100 * torch.rand(2, 50, 3)).sum(dim=1).allclose(torch.ones(2))
        True
    """

    def __init__(
        self, model: PointClassifier, num_points: int, preparation: Preparation = PAPER
    ) -> None:
        super().__init__()
        self.model, self.num_points, self.preparation = model, num_points, preparation

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b k"]:
        """Return the probabilities of the classes."""
        chosen = subsample_in_a_graph(points.double(), self.num_points)
        logits = self.model(normalise_in_a_graph(chosen, self.preparation).float())
        return torch.softmax(logits.double(), dim=1).float()


def subsample_in_a_graph(points: Float[Tensor, "b n 3"], num_points: int) -> Float[Tensor, "b m 3"]:
    """Bring clouds to one size as `qs3.io.preparation.resample`, in one graph for every n.

    Example:
        >>> subsample_in_a_graph(torch.tensor([[[0.0, 0, 0], [1, 0, 0]]]), 3)[0, :, 0].tolist()
        [0.0, 1.0, 0.0]
    """
    # A tensor, for what depends on the number of points must be computed and not decided.
    count = torch.ones_like(points[0, :, 0], dtype=torch.int64).sum()
    order = torch.arange(num_points, device=points.device) % count
    chosen = order.expand(points.shape[0], -1).clone()
    # Where there are too few points the order stays, and no step is made.
    end = torch.where(count > num_points, num_points, 1)
    chosen = sample_in_a_loop(points.permute(2, 0, 1).contiguous(), chosen, end, repeat=True)
    return points.gather(1, chosen[:, :, None].expand(-1, -1, 3))


def export_run(run: Path, to: str, out: Path | None = None) -> Exported:
    """Write the network of a run for use without qs3, and compare the file with the source.

    The file is made in memory, run on random clouds of many sizes, and written only where its
    answers are the source's.

    Args:
        run: Folder of the run, or a ``.safetensors`` file that training wrote.
        to: The format, onnx or torch-export.
        out: The file; where None, ``model.onnx`` or ``model.pt2`` beside the weights, or for a
            network that comes with qs3 in the working directory. An earlier export there is
            replaced.

    Raises:
        InputError: where the run or the name of the file is not usable.
        MissingExtraError: where the packages for ONNX are absent.
        QS3Error: where the network cannot be exported, or the file gives other answers.
    """
    if to not in SUFFIXES:
        raise no_such(f"unknown format {to!r}", to, SUFFIXES)
    if to == "onnx":
        _require_onnx()
    loaded = load_model(run)
    path = workplace(run) / f"model{SUFFIXES[to]}" if out is None else Path(out)
    _check_place(path, to)
    num_points = loaded.settings["train"].get("num_points")
    if num_points is None:
        raise InputError(f"{run}: does not tell the number of points a cloud (num_points)")
    # What a caller has to do to a cloud first; the rest is inside.
    expects = {
        "distinct": loaded.preparation.counts_points,
        "outliers_removed": loaded.preparation.remove_outliers,
        "most": max(LARGEST, num_points),
    }
    facts = {
        "class_names": list(loaded.class_names),
        "settings": loaded.settings,
        "expects": expects,
    }
    start = time.perf_counter()
    inside = replace(loaded.preparation, remove_outliers=False)
    data, runner = _serialise(loaded.model, num_points, inside, facts, to)
    seconds = time.perf_counter() - start
    differences = compare(loaded.model, num_points, runner, loaded.preparation)
    worst, strays = float(differences.max()), int((differences > ROUNDING).sum())
    if strays > STRAYS[0] or worst > STRAYS[1]:
        raise QS3Error(
            f"{path}: not written: on {strays} of {len(differences)} random clouds its "
            f"probabilities are not the source's (difference up to {worst:.1e}); use the other "
            "format"
        )
    write_bytes(path, data)
    return Exported(path, worst, strays, len(differences), seconds, expects)


def compare(
    model: PointClassifier,
    num_points: int,
    runner: _Runner,
    preparation: Preparation = PAPER,
    seed: int = 0,
) -> Float[np.ndarray, "m"]:
    """Return for each of many clouds the largest difference of an exported network's probability.

    The clouds have one point, few, as many as the network takes, one fewer, one more, and many;
    they lie off the origin, are as large as 0.001 to 1000, and come alone and by threes. Where the
    preparation removes points, those alone are raw: each point is there twice, and strays are; what
    is left of them by `distinct_inliers` is what the network gets. An answer of the wrong shape, or
    one that is not finite, differs infinitely.

    Args:
        model: The source.
        num_points: Points a cloud that it was trained on.
        runner: From clouds to probabilities, by the exported network.
        preparation: What the source does to the clouds.
        seed: Of the clouds.
    """
    rng = np.random.default_rng(seed)
    differences: list[float] = []
    inside = replace(preparation, remove_outliers=False, redraw=False)
    sizes = {1, 2, max(1, num_points // 3), num_points - 1, num_points, num_points + 1}
    for n in sorted({*sizes, 2 * num_points + 5} - {0}):
        for b in (1, 3):
            # Boxes of many shapes and sizes, away from the origin.
            points = rng.normal(size=(b, n, 3)) * rng.uniform(0.1, 1, size=(b, 1, 3))
            points = (points + rng.normal(size=(b, 1, 3))) * 10.0 ** rng.uniform(-3, 3)
            points, how = points.astype(np.float32), inside
            given = points
            if b == 1 and preparation.counts_points:
                cloud, how = points[0], preparation
                cloud = np.concatenate([cloud, cloud, cloud[:2] + 50 * np.ptp(cloud, axis=0)])
                kept = distinct_inliers(cloud, how.remove_outliers, max(LARGEST, num_points))
                points, given = cloud[None], cloud[kept][None]
            with unsaid():  # of sizes that are drawn here
                wanted = predict_probabilities(
                    model, points, num_points=num_points, preparation=how
                )
            got = runner(given)
            if got.shape != wanted.shape or not np.isfinite(got).all():
                differences += [float("inf")] * b
            else:
                differences += np.abs(got - wanted).max(axis=1).tolist()
    return np.array(differences)


def _require_onnx() -> None:
    for package in ("onnx", "onnxscript", "onnxruntime"):
        try:
            __import__(package)
        except ImportError as error:
            raise MissingExtraError(package, "export", error) from error


def _check_place(path: Path, to: str) -> None:
    """Refuse what is no place for a file of this format, or holds what no export wrote."""
    if path.suffix != SUFFIXES[to]:
        raise InputError(f"{path}: name a file that ends in {SUFFIXES[to]} for {to}")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file for --out")
    if path.exists() and not (_is_onnx(path) if to == "onnx" else _is_program(path)):
        raise InputError(f"{path}: holds something else than an export of qs3; name another file")


def _is_onnx(path: Path) -> bool:
    import onnx

    try:
        model = onnx.load(path, load_external_data=False)
    except Exception:  # a stranger's file: whatever the parser says, it is not ours
        return False
    return any(entry.key == KEY for entry in model.metadata_props)


def _is_program(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(f"extra/{KEY}") for name in archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def _serialise(
    model: PointClassifier,
    num_points: int,
    preparation: Preparation,
    facts: Mapping[str, Any],
    to: str,
) -> tuple[bytes, _Runner]:
    """Return the file's bytes, and a way to run them."""
    network = CloudClassifier(model, num_points, preparation).eval().requires_grad_(False)
    # Its values do not matter; sizes that are not 1 nor num_points fix nothing.
    example = torch.zeros(2, num_points + 3, 3)
    text = json.dumps(facts, ensure_ascii=False, sort_keys=True)
    try:
        with _quietly(), torch.no_grad():
            sizes = {axis: torch.export.Dim(name, min=1) for axis, name in _AXES.items()}
            program = torch.export.export(
                network, (example,), dynamic_shapes=(sizes,), strict=False
            )
            if to == "onnx":
                return _onnx_bytes(program, text)
            return _program_bytes(program, text)
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise QS3Error(
            f"{type(model).__name__} cannot be exported to {to} by PyTorch {torch.__version__}: "
            f"{reason}"
        ) from error


def _program_bytes(program: Any, text: str) -> tuple[bytes, _Runner]:
    # They would be pickled; without them nothing in the file is.
    program.example_inputs = None
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={KEY: text})
    data = buffer.getvalue()
    module = torch.export.load(io.BytesIO(data)).module()
    return data, lambda points: module(torch.from_numpy(points)).detach().numpy()


def _onnx_bytes(program: Any, text: str) -> tuple[bytes, _Runner]:
    import onnxruntime

    made = torch.onnx.export(
        program,
        dynamo=True,
        input_names=["points"],
        output_names=["probabilities"],
        dynamic_shapes=(_AXES,),
        verbose=False,
    )
    assert made is not None  # noqa: S101
    made.model.metadata_props[KEY] = text
    data = made.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    return data, lambda points: np.asarray(session.run(None, {"points": points})[0])


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Keep back what the exporters say of their own insides."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(before)
