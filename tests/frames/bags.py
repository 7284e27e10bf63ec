"""Recordings, written by librealsense and rosbags themselves."""

import dataclasses
import time
from pathlib import Path

import cv2
import numpy as np

RATE = 30
_TOPIC = "/camera/depth/image_raw"


def write_realsense(path, frames):
    """Let librealsense record a camera made of software; as .bag, from version 2.58 on as .db3."""
    import pyrealsense2 as rs

    device = rs.software_device()
    sensor = device.add_sensor("Stereo Module")
    camera = frames[0].camera
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy = camera.width, camera.height, camera.fx, camera.fy
    lens.ppx, lens.ppy, lens.model = camera.cx, camera.cy, rs.distortion.brown_conrady
    profiles = []
    kinds = ((rs.stream.depth, rs.format.z16, 2), (rs.stream.color, rs.format.rgb8, 3))
    for number, (kind, layout, size) in enumerate(kinds):
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.bpp, stream.fps = kind, layout, size, RATE
        stream.index, stream.uid, stream.intrinsics = 0, number, lens
        stream.width, stream.height = camera.width, camera.height
        profiles.append(sensor.add_video_stream(stream).as_video_stream_profile())
    same = rs.extrinsics()
    same.rotation, same.translation = [1.0, 0, 0, 0, 1, 0, 0, 0, 1], [0.0, 0, 0]
    profiles[1].register_extrinsics_to(profiles[0], same)
    profiles[0].register_extrinsics_to(profiles[1], same)
    sensor.add_read_only_option(rs.option.depth_units, camera.depth_scale)
    try:
        recorder = rs.recorder(str(path := path.with_suffix(".bag")), device)
    except RuntimeError:
        recorder = rs.recorder(str(path := path.with_suffix(".db3")), device)
    recorded = recorder.query_sensors()[0]
    recorded.open(recorded.get_stream_profiles())
    queue = rs.frame_queue(100)
    recorded.start(queue)
    for number, frame in enumerate(frames):
        images = (_steps(frame), np.zeros((*frame.depth.shape, 3), np.uint8))
        for image, profile, (_, _, size) in zip(images, profiles, kinds, strict=True):
            video = rs.software_video_frame()
            video.pixels, video.bpp, video.stride = image, size, size * camera.width
            video.timestamp, video.domain = frame.timestamp * 1000, rs.timestamp_domain.system_time
            video.frame_number, video.profile = number + 1, profile
            sensor.on_video_frame(video)
        time.sleep(0.03)
    recorded.stop()
    recorded.close()
    recorder.pause()
    del recorder
    return path


def _steps(frame):
    step = np.float32(frame.camera.depth_scale)
    return np.rint(np.nan_to_num(frame.depth) / step).astype(np.uint16)


def _is_packed(encoding):
    return ";" in encoding or encoding in ("compressedDepth", "jpeg", "png")


def _messages(store, frame, encoding, change, lens, big, padding, facts):
    """The image and the camera's message."""
    types = store.types
    header = types["std_msgs/msg/Header"]
    named = {"stamp": types["builtin_interfaces/msg/Time"](0, 0), "frame_id": "camera"}
    if "seq" in header.__dataclass_fields__:
        named["seq"] = 0
    header = header(**named)
    steps = _steps(frame)
    height, width = steps.shape
    if _is_packed(encoding):
        head = bytes(12) if "compressedDepth" in encoding else b""
        metres = np.nan_to_num(frame.depth).astype(np.float32)
        pixels = metres if encoding.startswith("32FC1") else steps
        ending = ".tiff" if pixels is metres or "tiff" in encoding else ".png"
        data = np.frombuffer(head + cv2.imencode(ending, pixels)[1].tobytes(), np.uint8)
        form = "16UC1; compressedDepth png" if encoding == "compressedDepth" else encoding
        image = types["sensor_msgs/msg/CompressedImage"](header, form, data)
    else:
        pixels = np.nan_to_num(frame.depth) if encoding == "32FC1" else steps
        if encoding == "rgb8":
            pixels = np.zeros((height, 3 * width), np.uint8)
        pixels = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        named = {"height": height, "width": width, "encoding": encoding, "is_bigendian": int(big)}
        named |= {"step": rows.shape[1], "data": rows.ravel(), **change}
        image = types["sensor_msgs/msg/Image"](header, **named)
    camera = frame.camera
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    p = np.array([camera.fx + any(lens), 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0.0])
    matrices = {"d": np.array(lens, float), "k": k, "r": np.eye(3).ravel(), "p": p}
    matrices |= {name: facts[name] for name in matrices if name in facts}
    if "K" in types["sensor_msgs/msg/CameraInfo"].__dataclass_fields__:
        matrices = {name.upper(): value for name, value in matrices.items()}
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
    sizes = {"height": height, "width": width, "binning_x": 0, "binning_y": 0}
    sizes |= {name: facts[name] for name in sizes if name in facts}
    if "frame_id" in facts:
        header = dataclasses.replace(header, frame_id=facts["frame_id"])
    model = facts.get("model", "plumb_bob")
    info = types["sensor_msgs/msg/CameraInfo"](
        header, distortion_model=model, roi=roi, **matrices, **sizes
    )
    return image, info


def _fill(writer, store, pack, frames, encoding, topics, info=True, change=None, lens=(0.0,) * 5,
          big=False, padding=0, brings=None, facts=()):  # fmt: skip
    packed = _is_packed(encoding)
    kind = "sensor_msgs/msg/CompressedImage" if packed else "sensor_msgs/msg/Image"
    for topic in topics:
        ending = ""
        if packed:
            ending = "/compressedDepth" if "compressedDepth" in encoding else "/compressed"
        definition = {"msgdef": brings, "md5sum": "0" * 32} if brings else {"typestore": store}
        ways = [writer.add_connection(topic + ending, kind, **definition)]
        if info:
            beside = f"{topic.rpartition('/')[0]}/camera_info"
            kind_of_info = "sensor_msgs/msg/CameraInfo"
            ways.append(writer.add_connection(beside, kind_of_info, typestore=store))
        for number, frame in enumerate(frames):
            stamp = round(frame.timestamp * 1e9)
            stated = facts[min(number, len(facts) - 1)] if facts else {}
            both = _messages(store, frame, encoding, change or {}, lens, big, padding, stated)
            for way, message in zip(ways, both, strict=False):
                writer.write(way, stamp, pack(message, way.msgtype))


def write_ros1(path, frames, encoding, kind, name=_TOPIC, info=True, lens=(0.0,) * 5, big=False,
               padding=0, brings=None, facts=(), **change):  # fmt: skip
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    path = Path(path).with_suffix(".bag")
    writer = Writer(path)
    if kind == "ros1-lz4":
        writer.set_compression(Writer.CompressionFormat.LZ4)
    with writer:
        _fill(writer, store, store.serialize_ros1, frames, encoding, (name,), info, change, lens,
              big, padding, brings, facts)  # fmt: skip
    return path


def write_ros2(path, frames, encoding, kind, topics=(_TOPIC,), facts=()):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    modes = {"mcap-zstd": CompressionMode.STORAGE, "message-zstd": CompressionMode.MESSAGE}
    if kind in modes:
        writer.set_compression(modes[kind], CompressionFormat.ZSTD)
    with writer:
        _fill(writer, store, store.serialize_cdr, frames, encoding, topics, facts=facts)
    return path
