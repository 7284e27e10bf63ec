"""What a page is to tell, as a user sets it."""

from dataclasses import dataclass
from pathlib import Path

from qs3.errors import InputError
from qs3.io.clouds import CloudKind


@dataclass(frozen=True)
class ReportSettings:
    """What to tell about the runs of a folder."""

    data: str | None = None
    """Labelled clouds to score and to look at; by default those that the record names, if they
    still lie near the run. Their labels serve the page only."""
    split: str | None = None
    """Part of the data, such as test."""
    cloud: CloudKind | None = None
    """Of generated data: the cloud to score; by default that of the record or of the run."""
    source: str | None = None
    """Labelled clouds of the source to look at; by default those that the run read."""
    source_split: str | None = None
    """Part of the source."""
    source_cloud: CloudKind | None = None
    """Of a generated source: the cloud to look at; by default that which the run read."""
    run: Path | None = None
    """Of several runs the one to tell about in full; by default the first qbst, else the first
    that was adapted, else the first."""
    before: Path | None = None
    """Run to compare with; by default the warm-up, or the source-only run of the same settings."""
    clouds: int = 200
    """Clouds to step through, half of them of each domain."""

    def __post_init__(self) -> None:
        if self.clouds < 0:
            raise InputError(f"--clouds {self.clouds}: must not be negative")
        parts = {"data": ("split", "cloud"), "source": ("source_split", "source_cloud")}
        for place, part in ((place, part) for place, own in parts.items() for part in own):
            if getattr(self, place) is None and getattr(self, part) is not None:
                option = part.replace("_", "-")
                raise InputError(f"--{option} goes with --{place}; name the clouds")
