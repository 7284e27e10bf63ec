"""Messages advise options that the commands which print them have."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import qs3

from ..test_docs import options

ROOT = Path(qs3.__file__).parent
DEPTH = "extract depth,segment,find"
CAMERAS = f"{DEPTH},capture,watch,realism"
PRINTED_BY = {
    "answers/to_onnx.py": "export",
    "clouds/columns.py": "segment",
    "clouds/layouts/folders.py": "convert",
    "clouds/load.py": "convert",
    "files.py": "generate,adapt,train,merge,report,extract depth",
    "frames/images.py": f"{DEPTH},realism",
    "frames/png_and_tiff.py": CAMERAS,
    "frames/frame.py": "capture,watch",
    "frames/cameras.py": "capture,watch",
    "frames/rosbag.py": "capture,watch",
    "frames/camera_files.py": CAMERAS,
    "frames/camera_tables.py": CAMERAS,
    "meshes/classes.py": "evaluate",
    "meshes/inspecting.py": "meshes",
    "meshes/sizes.py": "scan",
    "meshes/trees.py": "generate,meshes",
    "objects/bop.py": "extract depth",
    "objects/depth.py": "extract depth",
    "objects/run.py": "extract nyuv2,extract scannet",
    "objects/scene_files.py": "segment",
    "objects/segment.py": "segment,watch",
    "parts/locate_files.py": "find",
    "parts/scenes/finding.py": "find,watch",
    "parts/scenes/frames.py": "find",
    "parts/scenes/tabletop.py": "find,watch",
    "report/collect.py": "report",
    "report/found_parts.py": "find",
    "report/page.py": "report,adapt",
    "report/view.py": "view",
    "runs/bundled.py": "export",
    "runs/device.py": "train",
    "runs/rounds.py": "train",
    "runs/run.py": "train",
    "sensor/realism.py": "realism",
    "sensor/stage/settings.py": "scan,generate",
    "store/executors/ray_cluster.py": "generate",
    "store/manifest.py": "generate,extract depth",
    "workflow/adapt.py": "adapt",
    "workflow/inputs.py": "adapt",
    "workflow/labels.py": "adapt",
    "workflow/like.py": "generate",
    "workflow/sizes.py": "adapt",
    "workflow/training.py": "train",
    "workflow/watch.py": "watch",
}
"""Modules below the command line whose messages name options, and the commands that print them."""
_NAMED = re.compile(r"qs3 (?P<verb>[a-z]+)[^;:.`()]*?(?P<option>--[a-z][a-z.-]*[a-z])|"
                    r"(?<![\w'-])(?<!ray start )(?P<alone>--[a-z][a-z.-]*[a-z])")  # fmt: skip


@cache
def advised(path):
    """Verbs, if they are named, and options in the messages of a module: strings but docstrings."""
    text = path.read_text(encoding="utf-8")
    if not _NAMED.search(text):
        return frozenset()
    nodes = [*ast.walk(ast.parse(text))]
    docs = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    words = {
        id(word) for node in nodes if isinstance(node, ast.Tuple | ast.List) for word in node.elts
    }  # of commands
    words |= {id(word) for node in nodes if isinstance(node, ast.Call)
              for word in node.args if getattr(node.func, "id", "") == "command"}  # fmt: skip
    found = set()
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            docs |= {id(part) for part in node.values}
            text = "".join(part.value if isinstance(part, ast.Constant) else "…"
                           for part in node.values)  # fmt: skip
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
        else:
            continue
        if id(node) not in docs | words:
            found |= {(one["verb"], one["option"] or one["alone"]) for one in _NAMED.finditer(text)}
    return frozenset(found)


@pytest.mark.parametrize("name", PRINTED_BY)
def test_advised_options_exist_in_every_command_that_prints_the_message(name):
    for named, option in advised(ROOT / name):
        for verb in [named] if named else PRINTED_BY[name].split(","):
            assert option in options(verb), f"qs3 {verb} has no {option}"


def test_any_other_module_names_the_command_whose_option_it_advises():
    for path in ROOT.rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        if name not in PRINTED_BY and name.partition("/")[0] not in ("cli", "evaluation", "paper"):
            for verb, option in advised(path):
                assert verb, f"{name} advises {option}: of which command?"
                assert option in options(verb), f"qs3 {verb} has no {option}"
