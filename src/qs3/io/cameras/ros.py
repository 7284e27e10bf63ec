"""Depth images out of recordings of ROS 1 and ROS 2, without ROS (rosbags, extra ``ros``)."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from qs3.errors import InputError, MissingExtraError
from qs3.io.cameras.depth_frame import Camera, depth_frame
from qs3.io.extract.intrinsics import Intrinsics, camera_of, read_intrinsics
from qs3.io.pictures import decode_image
from qs3.reading import reading

_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_DEPTH = re.compile(r"16UC1|mono16|32FC1|16UC1;\s*compressedDepth(\s+png)?")


def ros_camera(path: Path, topic: str = "", intrinsics: str = "") -> Camera:
    """Yield the depth images of a ROS bag; whole numbers are millimetres, others metres (REP 118).

    ``path`` is a .bag of ROS 1; of ROS 2 the folder with metadata.yaml, a .db3 or a .mcap. A
    ``topic`` (16UC1, 32FC1 or compressedDepth) is needed if there are several. The camera is that
    of ``intrinsics``, else the CameraInfo beside the images.
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
        topics = [name for name in images if _DEPTH.fullmatch(_encoding(first[name]))]
        chosen = [name for name in topics if topic in ("", name)]
        if len(chosen) != 1:
            raise InputError(
                f"--topic must name one topic of depth images: {', '.join(topics) or 'none'}"
            )
        topic, beside = chosen[0], []
        if camera is None:
            infos = [name for name, kind in kinds.items() if kind == "CameraInfo"]
            stem = topic.removesuffix("/compressedDepth").rpartition("/")[0]
            beside = [name for name in infos if name.rpartition("/")[0] == stem] or infos
            info = next(messages(beside[0]), (0, 0, None))[2] if len(beside) == 1 else None
            if info is None or info.header.frame_id != first[topic].header.frame_id:
                raise InputError(f"{topic} has no CameraInfo beside it; give --intrinsics")
            camera = _camera(info, topic)
        number = 0
        for name, time, message in messages(topic, *beside):
            if name == topic:
                yield depth_frame(_pixels(message), camera, topic, f"{number:06d}", time)
                number += 1
            elif _camera(message, topic) != camera:
                raise InputError(f"{name} changes on the way; give --intrinsics, or cut the bag")


def _camera(info: Any, topic: str) -> Intrinsics:
    rectified = re.search(r"(^|[/_])rect", topic) is not None
    return camera_of({**vars(info), "roi": vars(info.roi)}, topic, rectified)


def _encoding(message: Any) -> str:
    return getattr(message, "format", "") or getattr(message, "encoding", "")


def _pixels(message: Any) -> Shaped[np.ndarray, "h w"]:
    if hasattr(message, "format"):
        image = decode_image(bytes(message.data[12:]))  # after its header
        if image.dtype != np.uint16 or image.ndim != 2:
            raise InputError(f"compressedDepth holds {image.dtype} {image.shape}, not 16 bits")
        return image
    kind = np.dtype(_KINDS[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.reshape(message.data, (message.height, message.step))
    rows = np.ascontiguousarray(rows[:, : message.width * kind.itemsize])
    return rows.view(kind).reshape(message.height, message.width)
