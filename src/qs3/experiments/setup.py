"""What a folder of a reproduction is for, and the file in it that says so."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from qs3.errors import InputError
from qs3.experiments.bench_data import make_plans
from qs3.experiments.domains import Domain, own_domain
from qs3.experiments.grid import RESULTS
from qs3.experiments.runs import parse_record_name
from qs3.experiments.scales import Scale
from qs3.files import claim_folder, read_json, write_json
from qs3.io import load_clouds
from qs3.io.clouds import CloudKind
from qs3.store.plan import Plan

MARKER = "bench.json"


@dataclass(frozen=True)
class Setup:
    """Where and how large; what all tables of a folder share."""

    out: Path
    """Folder of data, runs, records and tables."""
    scale: Scale
    """Size."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings; the data are the same for all."""
    threads: int | None = None
    """CPU threads of a training."""
    workers: int = 2
    """Processes that scan, and that train where no device is named."""
    devices: tuple[str, ...] = ()
    """GPUs, by index: each makes one run at a time."""
    executor: Literal["local", "ray"] = "local"
    """Where runs are made: here, or on a Ray cluster that sees the same folders."""
    address: str = "auto"
    """Of the Ray cluster's head; ``auto`` is this machine's, ``local`` starts one here."""
    shared: Path | None = None
    """Folder with artists' meshes and real objects; None takes procedural shapes alone."""
    own: Mapping[str, Domain] = field(default_factory=dict)
    """The user's data sets."""


def claim(setup: Setup, plans: Mapping[str, Plan]) -> None:
    """Write down what the folder is for, or check that it is for the same.

    Raises:
        InputError: where it is for another scale, other threads, meshes or data.
    """
    claim_folder(setup.out, MARKER)
    wanted = json.loads(
        json.dumps(
            {
                "scale": dataclasses.asdict(setup.scale),
                "threads": setup.threads,
                "meshes": _meshes(plans, setup),
                "data": {name: _own_data(one, setup.scale) for name, one in setup.own.items()},
            }
        )
    )
    path = setup.out / MARKER
    if not path.is_file():
        write_json(path, wanted)
        return
    there: Any = read_json(path)
    for name, value in wanted.items():
        if not isinstance(there, dict) or there.get(name) != value:
            raise InputError(f"{setup.out}: holds a bench of another {name}; name another --out")


def read_setup(folder: Path) -> Setup:
    """Return the setup of a folder that holds records, with the seeds that are there.

    Raises:
        InputError: where the folder was not made by ``qs3 reproduce``, or by another version.
    """
    from qs3.experiments.scales import SCALES

    if not (folder / MARKER).is_file():
        raise InputError(f"{folder}: has no {MARKER}; name a folder that qs3 reproduce made")
    there: Any = read_json(folder / MARKER)
    if not _is_marker(there):
        raise InputError(f"{folder / MARKER}: is not what qs3 reproduce writes")
    scale = SCALES.get(str(there["scale"].get("name")))
    if scale is None or json.loads(json.dumps(dataclasses.asdict(scale))) != there["scale"]:
        raise InputError(f"{folder / MARKER}: is of a scale that this version does not have")
    own = {}
    for name, one in there["data"].items():
        own[name] = own_domain(
            name, one["name"], one["cloud"], one["train_split"], one["test_split"]
        )
    names = [parse_record_name(path.name) for path in (folder / RESULTS).glob("*.json")]
    seeds = tuple(sorted({name[2] for name in names if name is not None}))
    return Setup(
        out=folder, scale=scale, seeds=seeds or (0, 1, 2), threads=there["threads"], own=own
    )


def _is_marker(value: Any) -> bool:
    if not isinstance(value, dict) or set(value) != {"scale", "threads", "meshes", "data"}:
        return False
    threads, data = value["threads"], value["data"]
    return (
        isinstance(value["scale"], dict)
        and (threads is None or type(threads) is int)
        and isinstance(data, dict)
        and all(isinstance(one, dict) and set(one) == _OWN_FIELDS for one in data.values())
        and all(
            isinstance(one["name"], str)
            and one["cloud"] in get_args(CloudKind)
            and all(isinstance(one[part] or "", str) for part in ("train_split", "test_split"))
            for one in data.values()
        )
    )


def _own_data(one: Domain, scale: Scale) -> dict[str, Any]:
    """Return what the user's domain is known by; reading it tells early what is wrong with it."""
    sums = [
        load_clouds(
            one.train, split=split, cloud=one.cloud, num_points=scale.train.num_points
        ).checksum
        for split in (one.train_split, one.test_split)
    ]
    return {
        "name": Path(one.train).name,
        "cloud": one.cloud,
        "train_split": one.train_split,
        "test_split": one.test_split,
        "train": sums[0],
        "test": sums[1],
    }


_OWN_FIELDS = {"name", "cloud", "train_split", "test_split", "train", "test"}


def _meshes(plans: Mapping[str, Plan], setup: Setup) -> str:
    """Return which meshes take part; `second` is of shapes always."""
    found = {plan.settings.meshes for name, plan in plans.items() if name != "second"}
    if found:
        return found.pop()
    return make_plans(setup.scale, setup.shared, sets=["source"])["source"].settings.meshes
