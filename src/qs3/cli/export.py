"""``qs3 export``: a trained network as ONNX."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.text import notify, show


def export(run: Annotated[Path, tyro.conf.Positional], out: Path | None = None) -> int:
    """Export a network as ONNX.

    The file takes clouds of a fixed number of points and returns probabilities. It is compared with
    PyTorch before it is written.

    Args:
        run: Folder of a run, its model.safetensors, or a network that comes with qs3: rooms.
        out: The file; default: model.onnx in the run. A network that comes with qs3 needs a name.
    """
    from qs3.answers.to_onnx import CLOUDS, export_run

    done = export_run(run, out)
    show(done.path)
    notify(
        f"{done.path.stat().st_size / 1e6:.1f} MB in {done.seconds:.0f} s; on {CLOUDS} random "
        f"clouds its probabilities differ from PyTorch's by at most {done.difference:.1e}"
    )
    cloud, expects = "cloud", done.expects
    if expects["distinct"]:
        cloud += f"[distinct_inliers(cloud, {expects['outliers_removed']}, {expects['most']})]"
    notify(
        "prepare each cloud by the functions of qs3.clouds.preparation first: "
        f"resample({cloud}, {expects['points']})"
    )
    return 0
