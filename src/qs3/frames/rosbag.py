"""Depth images out of recordings of ROS 1 and ROS 2, without ROS (rosbags, extra ``ros``)."""

import bz2
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Shaped

from qs3.errors import InputError, MissingExtraError
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.camera_tables import camera_of
from qs3.frames.frame import Camera, depth_frame
from qs3.frames.intrinsics import Intrinsics
from qs3.frames.png_and_tiff import decode_image
from qs3.reading import naming, reading, unpack

_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_PACKED = re.compile(
    r"(16UC1|mono16);\s*(?P<header>compressedDepth(\s+png)?)|"
    r"(16UC1|mono16);\s*png compressed\s*(16UC1|mono16)?|"
    r"(16UC1|mono16|32FC1);\s*tiff compressed\s*"
)
_READ = "16UC1, mono16 and 32FC1, and as compressedDepth or compressed the first two as PNG"
_HEADER = 12  # bytes before the PNG of compressedDepth


def ros_camera(path: Path, topic: str = "", intrinsics: str = "") -> Camera:
    """Yield the depth images of a ROS bag; whole numbers are millimetres, others metres (REP 118).

    ``path`` is a .bag of ROS 1; of ROS 2 the folder with metadata.yaml, a .db3 or a .mcap. A
    ``topic`` (16UC1, mono16 or 32FC1, raw or compressed without loss) is needed if there are
    several. The camera is that of ``intrinsics``, else the CameraInfo beside the images.
    """
    file = path / "metadata.yaml" if path.is_dir() else path
    frames = _frames(path, topic, read_intrinsics(intrinsics) if intrinsics else None)
    while True:
        with reading(file, "a ROS bag", streamed=True):
            frame = next(frames, None)
        if frame is None:
            return
        yield frame


def _frames(path: Path, topic: str, camera: Intrinsics | None) -> Camera:
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtraError("rosbags", "ros", error) from None
    _bound(rosbag1, rosbag2)
    old = path.suffix == ".bag"
    # The standard types: rosbags would execute code made of the definitions in a bag.
    types = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    read = types.deserialize_ros1 if old else types.deserialize_cdr
    with (rosbag1.Reader if old else rosbag2.Reader)(path) as reader:
        kinds = {each.topic: each.msgtype.rpartition("/")[2] for each in reader.connections}
        if any(name.startswith("/device_0/") for name in kinds):
            raise InputError(f"recorded by a RealSense, not by ROS: read it as bag:{path}")

        def messages(*names: str) -> Any:
            wanted = [each for each in reader.connections if each.topic in names]
            for connection, time, data in reader.messages(wanted):
                yield connection.topic, time / 1e9, read(data, connection.msgtype)

        images = [name for name, kind in kinds.items() if kind in ("Image", "CompressedImage")]
        first: dict[str, Any] = {name: next(messages(name), (name, 0, None))[2] for name in images}
        encodings = {name: _encoding(first[name]) for name in images}
        topics = [name for name in images if _is_depth(encodings[name])]
        chosen = [name for name in topics if topic in ("", name)]
        if len(chosen) != 1:
            listed = ", ".join(f"{name} ({encodings[name]})" for name in images) or "none"
            raise InputError(
                f"--topic must name one topic of depth images: {', '.join(topics) or 'none'}; its "
                f"images are {listed}; read are {_READ}"
            )
        topic, beside = chosen[0], []
        if camera is None:
            infos = [name for name, kind in kinds.items() if kind == "CameraInfo"]
            stem = topic.removesuffix("/compressedDepth").removesuffix("/compressed")
            stem = stem.rpartition("/")[0]
            beside = [name for name in infos if name.rpartition("/")[0] == stem] or infos
            info = next(messages(beside[0]), (0, 0, None))[2] if len(beside) == 1 else None
            if info is None or info.header.frame_id != first[topic].header.frame_id:
                raise InputError(f"{topic} has no CameraInfo beside it; give --intrinsics")
            camera = _camera(info, topic)
        number = 0
        for name, time, message in messages(topic, *beside):
            if name == topic:
                with naming(topic):
                    raw = _pixels(message)
                yield depth_frame(raw, camera, topic, f"{number:06d}", time)
                number += 1
            elif _camera(message, topic) != camera:
                raise InputError(f"{name} changes on the way; give --intrinsics, or cut the bag")


def _bound(rosbag1: Any, rosbag2: Any) -> None:
    """Let rosbags unpack no more than `reading` allows: by itself it takes what a chunk holds."""
    import lz4.frame

    zstd = rosbag2.reader.zstd
    packed = {
        "bz2": partial(unpack, "a chunk", bz2.BZ2Decompressor),
        "lz4": partial(unpack, "a chunk", lz4.frame.LZ4FrameDecompressor),
        "zstd": partial(unpack, "a chunk", zstd.ZstdDecompressor),
    }
    for name in ("bz2", "lz4"):
        rosbag1.reader.decompressors[name] = packed[name]
    for name in ("lz4", "zstd"):
        rosbag2.storage_mcap.DECOMPRESSORS[name] = lambda data, _, way=packed[name]: way(data)
    if not isinstance(zstd, SimpleNamespace):
        readers = {"decompress": packed["zstd"], "open": zstd.open}
        rosbag2.reader.zstd = SimpleNamespace(ZstdDecompressor=zstd.ZstdDecompressor, **readers)


def _camera(info: Any, topic: str) -> Intrinsics:
    rectified = re.search(r"(^|[/_])rect", topic) is not None
    return camera_of({**vars(info), "roi": vars(info.roi)}, topic, rectified)


def _encoding(message: Any) -> str:
    """Return how a message stores its picture; of a topic without a message that it has none."""
    if message is None:
        return "no message"
    return str(message.format if hasattr(message, "format") else message.encoding).strip()


def _is_depth(encoding: str) -> bool:
    return encoding in _KINDS or _PACKED.fullmatch(encoding) is not None


def _pixels(message: Any) -> Shaped[np.ndarray, "h w"]:
    if hasattr(message, "format"):
        encoding = _encoding(message)
        found = _PACKED.fullmatch(encoding)
        if found is None:
            raise InputError(f"its encoding changes on the way to {encoding}; cut the bag")
        image = decode_image(bytes(message.data[_HEADER if found["header"] else 0 :]))
        kind = np.dtype(_KINDS[encoding.partition(";")[0]])
        if image.dtype != kind or image.ndim != 2:
            raise InputError(f"{encoding} holds {image.dtype} {list(image.shape)}, not {kind}")
        return image
    if message.encoding not in _KINDS:
        raise InputError(f"its encoding changes on the way to {message.encoding}; cut the bag")
    kind = np.dtype(_KINDS[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.reshape(message.data, (message.height, message.step))
    rows = np.ascontiguousarray(rows[:, : message.width * kind.itemsize])
    return rows.view(kind).reshape(message.height, message.width)
