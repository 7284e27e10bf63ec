"""``qs3 report``: one self-contained page about a run."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from qs3.cli.text import show, tell
from qs3.errors import InputError
from qs3.io.clouds import CloudKind

if TYPE_CHECKING:
    from qs3.report.page import Report


def report(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    split: str | None = None,
    cloud: CloudKind = "points",
    source: str | None = None,
    before: Path | None = None,
    clouds: int = 200,
    mesh: str | None = None,
    sensor: str = "paper",
    out: Path | None = None,
) -> int:
    """Write one self-contained HTML page about a run.

    It holds scores, the confusion matrix, curves, rounds, clouds to turn and a scan.

    Args:
        run: Folder of a run.
        data: Labelled clouds to score and show; default: the scores of the last qs3 evaluate.
        split: Split of the data, such as test.
        cloud: Cloud of generated data.
        source: Labelled clouds of the source to show beside them.
        before: Run to compare with; default: the warm-up inside the run's folder.
        clouds: Clouds to step through, half of them of each domain.
        mesh: Mesh file or built-in class to scan for the page, step by step.
        sensor: Preset of the sensor for that scan, or a TOML file.
        out: The page; default: report.html in the folder.
    """
    from qs3.files import check_output
    from qs3.report.collect import collect
    from qs3.report.page import write_report
    from qs3.training.shipped import workplace

    out = workplace(run) / "report.html" if out is None else out
    check_output(out, "--out", ".html", ".htm")
    if clouds < 0:
        raise InputError(f"--clouds {clouds}: must not be negative")
    if data is None and split is not None:
        raise InputError("--split goes with --data; name the clouds")
    page = collect(run, data=data, split=split, cloud=cloud, source=source, before=before,
                   clouds=clouds)  # fmt: skip
    if mesh is not None:
        page = with_scan(page, mesh, sensor)
    write_report(out, page)
    show(out)
    tell(f"{out.stat().st_size / 1e6:.1f} MB, one file. Open it in a browser.")
    return 0


def with_scan(page: "Report", mesh: str, sensor: str) -> "Report":
    """Scan a mesh file or a built-in class step by step, and add the pictures."""
    from qs3.meshes.collections import load_named
    from qs3.report.montage import montage_view
    from qs3.sensor.scan import ScanSettings, scan

    shape, origin = load_named(mesh, 0)
    tell("scanning for the pictures …")
    made = scan(shape, ScanSettings(sensor=sensor, views=2), keep_images=True)
    title = f"{origin['name']} · sensor {made.sensor.name}"
    return replace(page, montage=montage_view(made)[0], montage_title=title)
