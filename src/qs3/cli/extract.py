"""``qs3 extract``: objects out of real scans, into a data set."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

Classes = tuple[str, ...]


@dataclass(frozen=True)
class OutOptions:
    """Where the clouds go."""

    out: str
    """Folder of the data set; run the same command again to go on after a stop."""
    num_points: int = 2048
    """Larger clouds are thinned to this many by farthest point sampling; smaller ones stay."""
    workers: int = 1
    """Processes; 0 does the work in this one. The bytes written do not depend on it."""
    retry_failed: bool = False
    """Do again what failed before."""


@dataclass(frozen=True)
class CutOptions:
    """Which pixels are kept."""

    near: float = 0.0
    """Depths at or below are dropped, in metres along the optical axis."""
    far: float = math.inf
    """Depths at or above are dropped."""
    erode: int = 0
    """Pixels by which a mask's edge is moved inwards."""
    flying: float = 0.0
    """Drop pixels with fewer than three of their eight neighbours within this many metres of depth;
    0 keeps all, as noise is to be kept."""
    min_points: int = 100
    """Objects of fewer points are left out."""


@dataclass(frozen=True)
class DepthOptions:
    """Cut objects from depth images of any camera, or from scenes in BOP's layout."""

    source: Annotated[Path, tyro.conf.Positional]
    """A depth image (16-bit PNG, TIFF, npy), a folder of them, or a scene in BOP's layout or a
    folder of such scenes, such as the frames/ of qs3 scan --frames."""
    output: Annotated[OutOptions, tyro.conf.arg(name="")]
    """Where the clouds go."""
    intrinsics: str = ""
    """fx,fy,cx,cy; a JSON file of a camera; or a text file of 3×3 numbers."""
    mask: Path | None = None
    """The mask of the image, or a folder of masks with the images' names; not 0 is the object."""
    instances: bool = False
    """Each number of a mask is an object of its own."""
    box: tuple[int, int, int, int] | None = None
    """First column and row of the object, and those after its last: u0 v0 u1 v1."""
    depth_scale: float | None = None
    """Metres a step of the images; 0.001 for whole numbers and 1 for others by default."""
    class_name: Annotated[str, tyro.conf.arg(name="class")] = ""
    """Class of every object; object, or obj_000001 and so on, by default."""
    names: Path | None = None
    """CSV with the columns name and class: of an image (a), an instance (a/1, or */1 in any image)
    or a model of BOP (1 or obj_000001)."""
    frame: Literal["auto", "world", "camera", "model"] = "auto"
    """Axes of the clouds, in BOP's layout: auto is the world where the scene tells it."""
    depth_folder: str = "depth"
    """Folder of the depth pictures in a scene of BOP's layout; depth_true, of qs3 scan --frames,
    gives clean twins."""
    gravity: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Downward direction in the camera's axes (x right, y down, z forward), which z is turned
    against."""
    split: str = ""
    """Name of the split of every object, such as train or test."""
    cut: Annotated[CutOptions, tyro.conf.arg(name="")] = field(default_factory=CutOptions)
    """Which pixels are kept."""


@dataclass(frozen=True)
class SunOptions:
    """Cut objects from SUN RGB-D by its oriented boxes."""

    root: Annotated[Path, tyro.conf.Positional]
    """The folder SUNRGBD of the release, or the one above it."""
    output: Annotated[OutOptions, tyro.conf.arg(name="")]
    """Where the clouds go."""
    boxes: Path | None = None
    """SUNRGBDMeta3DBB_v2.mat or a boxes.json; looked for at the root, above it and in the toolbox,
    then the frames' own annotation3Dfinal/index.json, by default."""
    splits: Path | None = None
    """The toolbox's allsplit.mat, which tells train from test."""
    classes: Classes = ("pointda10",)
    """Classes to map the objects onto; pointda10 for its ten, all for the annotators' own."""
    depth: Literal["refined", "raw"] = "refined"
    """depth_bfx (frames fused, holes filled) as the toolbox takes it, or depth as the camera gave
    it."""
    margin: float = 0.0
    """Metres by which each face of a box is moved outwards."""
    cut: Annotated[CutOptions, tyro.conf.arg(name="")] = field(
        default_factory=lambda: CutOptions(far=8.0)
    )
    """Which pixels are kept."""


@dataclass(frozen=True)
class ScanNetOptions:
    """Cut objects from ScanNet: fused from its raw depth frames, or from its meshes."""

    root: Annotated[Path, tyro.conf.Positional]
    """A copy of the release, its folder scans, or one scene's folder."""
    output: Annotated[OutOptions, tyro.conf.arg(name="")]
    """Where the clouds go."""
    from_mesh: bool = False
    """From the fused mesh, as ScanNet10, and not from the depth frames."""
    scenes: tuple[str, ...] = ()
    """Only these scenes; all by default."""
    splits_train: Path | None = None
    """The list of training scenes, such as scannetv2_train.txt."""
    splits_test: Path | None = None
    """The list of test scenes, such as scannetv2_val.txt."""
    classes: Classes = ("pointda10",)
    """Classes to map the objects onto; pointda10 for its ten."""
    every: int = 10
    """Step between the depth frames that are read; ScanNet has 30 a second."""
    near: float = 0.4
    """Smallest depth kept, in metres."""
    far: float = 4.0
    """Largest depth kept."""
    cut: Literal["auto", "masks", "mesh"] = "auto"
    """By the frames' instance masks or by nearness to the annotated mesh; auto takes the masks
    where the scene has them."""
    erode: int = 2
    """Pixels of the depth image by which masks shrink."""
    max_frames: int = 20
    """Frames fused to an object, drawn at random from those that see it; 0 fuses all."""
    min_pixels: int = 200
    """Pixels of an object that a frame needs to count."""
    voxel: float = 0.01
    """Edge of the voxels that keep one measured point each, in metres."""
    min_points: int = 512
    """Objects of fewer points are left out."""
    seed: int = 0
    """Seed of every choice."""


Options = (
    Annotated[ScanNetOptions, tyro.conf.subcommand("scannet", prefix_name=False)]
    | Annotated[SunOptions, tyro.conf.subcommand("sunrgbd", prefix_name=False)]
    | Annotated[DepthOptions, tyro.conf.subcommand("depth", prefix_name=False)]
)


def extract(options: Annotated[Options, tyro.conf.arg(name="")]) -> int:
    """Cut objects out of real scans into a data set; resumes, and logs what failed."""
    from qs3.cli import extract_work as work

    if isinstance(options, ScanNetOptions):
        return work.scannet(options)
    if isinstance(options, SunOptions):
        return work.sunrgbd(options)
    return work.depth(options)
