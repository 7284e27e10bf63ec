"""``qs3 export``: a trained network for use without qs3."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.cli.text import show, tell


def export(
    run: Annotated[Path, tyro.conf.Positional],
    to: Literal["onnx", "torch-export"],
    out: Path | None = None,
) -> int:
    """Export a network as ONNX or for PyTorch.

    It takes points of any number, with the run's pre-processing inside, and gives probabilities;
    the file is compared with the run first. It tells what is to be done to a cloud before.

    Args:
        run: Folder of a run, its model.safetensors, or a network that comes with qs3: rooms.
        to: onnx, which many programs run; or torch-export, which PyTorch runs without qs3.
        out: The file; model.onnx or model.pt2 in the run by default.
    """
    from qs3.training.export import ROUNDING, export_run

    done = export_run(run, to, out)
    show(done.path)
    tell(
        f"{done.path.stat().st_size / 1e6:.1f} MB in {done.seconds:.0f} s; on {done.clouds} random "
        f"clouds its probabilities differ from the run's by at most {done.difference:.1e}, "
        f"on {done.strays} by more than {ROUNDING:.0e}"
    )
    if done.expects["distinct"]:
        outliers, most = done.expects["outliers_removed"], done.expects["most"]
        tell(
            "before the file gets a cloud: cloud = cloud[qs3.io.preparation.distinct_inliers("
            f"cloud, {outliers}, {most})]; without it answers differ from qs3 predict"
        )
    return 0
