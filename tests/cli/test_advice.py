"""Messages advise options that the commands which print them have."""

import ast
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest

import qs3
from qs3.frames.cameras import CaptureSettings
from qs3.frames.infrared import PairFiles
from qs3.objects.listing import DepthImageSettings
from qs3.objects.run import OutputSettings
from qs3.objects.scene_files import SceneSettings
from qs3.objects.segment import SegmentSettings
from qs3.paper.data.nyuv2 import Nyuv2Settings
from qs3.paper.data.scannet import ScanNetSettings

EXTRACT, SEGMENT = (DepthImageSettings, OutputSettings), (SceneSettings,)
CAPTURE, WATCH = (CaptureSettings,), (CaptureSettings, SegmentSettings)
PRINTED_BY = {
    "frames/images.py": (EXTRACT, SEGMENT, (PairFiles,)),
    "frames/masks.py": (EXTRACT,),
    "frames/png_and_tiff.py": (EXTRACT, SEGMENT, CAPTURE, WATCH),
    "frames/frame.py": (CAPTURE, WATCH),
    "frames/folder.py": (CAPTURE, WATCH),
    "frames/cameras.py": (CAPTURE, WATCH),
    "frames/realsense.py": (CAPTURE, WATCH),
    "frames/rosbag.py": (CAPTURE, WATCH),
    "objects/bop.py": (EXTRACT,),
    "objects/cut.py": (EXTRACT, SEGMENT),
    "objects/depth.py": (EXTRACT,),
    "objects/listing.py": (EXTRACT,),
    "frames/infrared.py": ((PairFiles,),),
    "frames/camera_files.py": (EXTRACT, SEGMENT, CAPTURE, WATCH, (PairFiles,)),
    "frames/camera_tables.py": (EXTRACT, SEGMENT, CAPTURE, WATCH, (PairFiles,)),
    "paper/data/nyuv2.py": ((Nyuv2Settings, OutputSettings),),
    "objects/run.py": ((Nyuv2Settings, OutputSettings), (ScanNetSettings, OutputSettings)),
    "paper/data/scannet.py": ((ScanNetSettings, OutputSettings),),
    "objects/scene_files.py": (SEGMENT,),
    "objects/segment.py": (SEGMENT,),
}


def options(kind):
    """Names of the options of settings, and of settings in them."""
    hints = get_type_hints(kind)
    for own in fields(kind):
        yield "--" + own.name.replace("_", "-")
        inner = hints[own.name]
        if is_dataclass(inner):
            yield from options(inner)
    if "class_name" in hints:
        yield "--class"


def advised(path):
    """Options in the strings of a module that are no docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docs = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs:
            yield from re.findall(r"--[a-z][a-z-]*", node.value)


@pytest.mark.parametrize("name", PRINTED_BY)
def test_advised_options_exist_in_every_command_that_prints_the_message(name):
    found = set(advised(Path(qs3.__file__).parent / name))
    for kinds in PRINTED_BY[name]:
        assert found <= {option for kind in kinds for option in options(kind)}


def test_every_module_that_advises_an_option_is_listed():
    root = Path(qs3.__file__).parent
    for folder in ("frames", "objects"):
        for path in (root / folder).glob("*.py"):
            name = path.relative_to(root).as_posix()
            assert name in PRINTED_BY or not set(advised(path)), name
