"""Depth images out of recordings of ROS 1 and ROS 2, without ROS (rosbags, extra ``ros``).

Messages are read as the standard types; definitions that a bag brings along are not looked at.
"""

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from qs3.errors import InputError, MissingExtraError, say_once
from qs3.io.cameras.frames import Camera, DepthFrame
from qs3.io.extract.depth_images import MILLIMETRE, to_metres
from qs3.io.extract.intrinsics import Intrinsics, intrinsics_from_matrix, read_intrinsics
from qs3.io.guards import check_pixels, naming, read_image, read_text
from qs3.meshes.announced import memory_limit

IMAGE, PACKED, CAMERA = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo")
)
_KINDS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_PACKED = re.compile(r"16UC1;\s*compressedDepth(\s+png)?")
_HEADER = 12  # bytes before the PNG of compressedDepth


def ros_camera(path: Path, topic: str = "", intrinsics: str = "") -> Camera:
    """Yield the depth images of a ROS bag.

    Convention:
        Whole numbers are millimetres, numbers with a point metres (REP 118).

    Args:
        path: A .bag of ROS 1; of ROS 2 the folder with metadata.yaml, a .db3 or a .mcap.
        topic: Which topic of depth images (sensor_msgs/Image as 16UC1 or 32FC1, or their
            compressedDepth as PNG); empty where there is one alone.
        intrinsics: Of the camera; empty takes the CameraInfo beside the images.

    Raises:
        InputError: where there is no such bag or topic, several topics and none named, no
            CameraInfo, or it is damaged.
        MissingExtraError: where rosbags is not installed.
    """
    with ExitStack() as stack:
        bag = _Bag(path, stack)
        topic = _depth_topic(bag, topic)
        camera = read_intrinsics(intrinsics) if intrinsics else bag.camera(topic)
        for number, (time, message) in enumerate(bag.messages(topic)):
            raw = bag.guarded(_pixels, message)
            if raw is None:
                raise InputError(f"{path}: {topic}: message {number} is no depth image")
            camera.check_size(raw.shape, f"{path}: {topic}")
            step = MILLIMETRE if raw.dtype.kind == "u" else None
            own = Intrinsics(
                camera.fx, camera.fy, camera.cx, camera.cy, *raw.shape[::-1], depth_scale=step
            )
            yield DepthFrame(to_metres(raw), own, f"{number:06d}", time)


class _Bag:
    """An open recording of either ROS; each step under the limit of memory."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        try:
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingExtraError("rosbags", "ros", error) from None
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        metadata = path / "metadata.yaml"
        if metadata.is_file() and re.search(r"compression_mode:\W*file", read_text(metadata), re.I):
            raise InputError(f"{path}: its files are packed whole; unpack them first (unzstd)")
        self.path = path
        files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
        self._largest = max(files, key=lambda file: file.stat().st_size, default=path)
        old = path.suffix == ".bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
        self._read = self._types.deserialize_ros1 if old else self._types.deserialize_cdr
        self._reader = self.guarded(rosbag1.Reader if old else rosbag2.Reader, path)
        self.guarded(stack.enter_context, self._reader)
        self.topics = {each.topic: each.msgtype for each in self._reader.connections}
        if old and any(topic.startswith("/device_0/") for topic in self.topics):
            raise InputError(f"{path}: recorded by a RealSense, not by ROS: read it as bag:{path}")

    def guarded(self, work: Any, *given: Any) -> Any:
        """Do a step; whatever a damaged bag makes the library stumble over is one line."""
        with memory_limit(self._largest), naming(self.path, "cannot be read as a ROS bag"):
            return work(*given)

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield the messages of a topic with the time at which they were recorded, seconds."""
        wanted = [each for each in self._reader.connections if each.topic == topic]
        rows = iter(self._reader.messages(wanted))
        while (row := self.guarded(next, rows, None)) is not None:
            yield row[1] / 1e9, self.guarded(self._read, row[2], row[0].msgtype)

    def camera(self, topic: str) -> Intrinsics:
        """The camera of a topic of images: the CameraInfo beside it, else the bag's only one."""
        infos = [name for name, kind in self.topics.items() if kind == CAMERA]
        stem = topic.removesuffix("/compressedDepth").rpartition("/")[0]
        beside = [name for name in infos if name.rpartition("/")[0] == stem] or infos
        if len(beside) != 1:
            raise InputError(
                f"{self.path}: {topic} has no CameraInfo beside it ({', '.join(infos) or 'none'}); "
                "give --intrinsics"
            )
        _, info = next(self.messages(beside[0]), (0.0, None))
        if info is None:
            raise InputError(f"{self.path}: {beside[0]} is empty; give --intrinsics")
        return self.guarded(_intrinsics, info, topic)


def _intrinsics(info: Any, topic: str) -> Intrinsics:
    fields = {name.lower(): value for name, value in vars(info).items()}
    matrix, lens = np.reshape(fields["k"], (3, 3)), np.asarray(fields["d"])
    if "rect" in topic:  # those pixels are of P, without distortion
        matrix = np.reshape(fields["p"], (3, 4))[:, :3]
    elif lens.any():
        say_once(f"{topic}: its images have lens distortion, which is not undone")
    return intrinsics_from_matrix(matrix.astype(np.float64))


def _depth_topic(bag: _Bag, topic: str) -> str:
    """The topic asked for, or the only one whose first message is a depth image."""
    images = [name for name, kind in bag.topics.items() if kind in (IMAGE, PACKED)]
    topics = [name for name in images if _is_depth(next(bag.messages(name), (0.0, None))[1])]
    if topic in topics or (not topic and len(topics) == 1):
        return topic or topics[0]
    names = ", ".join(topics) or "none"
    if topic:
        raise InputError(f"{bag.path}: {topic} is no topic of depth images; such are {names}")
    if topics:
        raise InputError(
            f"{bag.path}: several topics of depth images; name one by --topic: {names}"
        )
    names = ", ".join(images) or "none"
    raise InputError(f"{bag.path}: no depth images (16UC1, 32FC1); topics of images: {names}")


def _is_depth(message: Any) -> bool:
    return _PACKED.fullmatch(getattr(message, "format", "")) is not None or (
        getattr(message, "encoding", "") in _KINDS
    )


def _pixels(message: Any) -> Shaped[np.ndarray, "h w"] | None:
    """The numbers of a depth image; None where it is none."""
    if not _is_depth(message):
        return None
    if hasattr(message, "format"):
        image, mode = read_image(bytes(message.data[_HEADER:]), "PNG")
        if not mode.startswith("I"):
            raise InputError(f"compressedDepth holds a picture of kind {mode}, not 16 bits")
        return image
    check_pixels(message.width, message.height)
    kind = np.dtype(_KINDS[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    held, row = len(message.data), message.width * kind.itemsize
    if message.step < row or held != message.step * message.height:
        raise InputError(
            f"an image of {message.width}×{message.height} pixels with rows of {message.step} "
            f"bytes, but {held} bytes of it"
        )
    rows = np.reshape(message.data, (message.height, message.step))[:, :row]
    return np.ascontiguousarray(rows).view(kind)
