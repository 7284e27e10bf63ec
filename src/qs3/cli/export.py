"""``qs3 export``: a trained network for use without qs3."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class ExportOptions:
    """Write a run's network with its pre-processing: points of any number in, probabilities out."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or its model.safetensors."""
    to: Literal["onnx", "torch-export"]
    """onnx, which many programs run; or torch-export, which PyTorch runs without qs3."""
    out: Path | None = None
    """The file; model.onnx or model.pt2 in the run by default."""


def export(options: Annotated[ExportOptions, tyro.conf.arg(name="")]) -> int:
    """Export a network as ONNX or for PyTorch; the file is compared with the run first."""
    from qs3.training.export import ROUNDING, export_run

    done = export_run(options.run, options.to, options.out)
    print(done.path)
    print(
        f"{done.path.stat().st_size / 1e6:.1f} MB in {done.seconds:.0f} s; on {done.clouds} random "
        f"clouds its probabilities differ from the run's by at most {done.difference:.1e}, "
        f"on {done.strays} by more than {ROUNDING:.0e}",
        file=sys.stderr,
    )
    return 0
