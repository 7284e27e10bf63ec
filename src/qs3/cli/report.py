"""``qs3 report``: one self-contained page about a run."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.text import notify, raise_last, show
from qs3.clouds.types import CloudKind
from qs3.errors import InputError


def report(
    run: Annotated[Path, tyro.conf.Positional],
    data: str | None = None,
    split: str | None = None,
    cloud: CloudKind = "points",
    source: str | None = None,
    scans: Path | None = None,
    before: Path | None = None,
    records: Path | None = None,
    clouds: int = 200,
    out: Path | None = None,
) -> int:
    """Write one self-contained HTML page about a run.

    It holds scores, the confusion matrix, curves, rounds and clouds to turn. A cloud that cannot be
    read or answered is reported at the end, and the exit code is 2; the page has the others.

    Args:
        run: Folder of a run.
        data: Labelled clouds to score and show; default: the scores of the last qs3 evaluate.
        split: Split of the data, such as test.
        cloud: Cloud of generated data.
        source: Labelled clouds of the source to show beside them.
        scans: Unlabelled clouds to show, by the class that the run answers. If the run has CAD, a
            page of them with their poses is written too: parts.html beside the page.
        before: Run to compare with; default: the warm-up inside the run's folder.
        records: File that qs3 evaluate --records wrote; default: records.jsonl of the run.
        clouds: Clouds to step through, half of them of each domain.
        out: The page; default: report.html in the folder of the run. A network that comes with qs3
            has none: name the page.
    """
    from qs3.checks import check_numbers
    from qs3.files import read_json, resolved
    from qs3.report.collect import answer_scans, collect
    from qs3.report.page import check_page, write_report
    from qs3.report.parts_page import write_parts_page
    from qs3.runs.bundled import workplace
    from qs3.workflow.labels import LEARNT
    from qs3.workflow.options import Written

    out = workplace(run) / Written.PAGE if out is None else out
    check_page(out)
    parts = out.parent / Written.PARTS_PAGE
    if scans is not None:
        if resolved(out) == resolved(parts):
            raise InputError(f"--out {out}: is the page of the parts; give the report another name")
        check_page(parts)
    check_numbers("--clouds", clouds, 0)
    if data is None and split is not None:
        raise InputError("--split goes with --data; name the clouds")
    if data is not None and records is not None:
        raise InputError("--records: the scores are those of --data; name one of both")
    answers = [] if scans is None else answer_scans(run, scans)
    if answers and all(answer.fault for answer in answers):
        raise_last([answer.fault for answer in answers], len(answers), "clouds")
    page = collect(run, data=data, split=split, cloud=cloud, source=source, scans=answers,
                   below=scans, before=before, records=records, clouds=clouds)  # fmt: skip
    write_report(out, page)
    show(out)
    if any(answer.candidates is not None for answer in answers):
        kept = workplace(run) / LEARNT
        learnt = read_json(kept) if kept.is_file() else {}
        write_parts_page(parts, answers, page.class_names, scans, learnt)
        show(parts)
    notify(f"{out.stat().st_size / 1e6:.1f} MB, one file. Open it in a browser.")
    raise_last(page.faults, page.total, "clouds")
    return 0
