"""Messages with Foxglove's schemas, as ROS 2 writes them: definitions, and their bytes in CDR.

A file with them is read by Foxglove, by rosbags and by the tools of ROS 2, which find the
definitions in the file. A message is a dict by the names of its fields; a field that is missing is
zero or empty. CDR is the Common Data Representation of OMG (DDS-XTypes 1.3, 7.4.1), little-endian:
every number lies at a multiple of its size, counted from the end of a header of four bytes.
"""

import math
import struct
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from neuroslam.mapping.tables import Links
from neuroslam.types import Pose

JPEG_QUALITY = 80
"""Of the pictures of a camera."""

FRAME_ID = "map"
"""Frame of poses, graph and path."""

DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "geometry_msgs/Point": "float64 x; float64 y; float64 z",
    "geometry_msgs/Vector3": "float64 x; float64 y; float64 z",
    "geometry_msgs/Quaternion": "float64 x; float64 y; float64 z; float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "foxglove_msgs/CompressedImage": (
        "builtin_interfaces/Time timestamp; string frame_id; uint8[] data; string format"
    ),
    "foxglove_msgs/PoseInFrame": (
        "builtin_interfaces/Time timestamp; string frame_id; geometry_msgs/Pose pose"
    ),
    "foxglove_msgs/PosesInFrame": (
        "builtin_interfaces/Time timestamp; string frame_id; geometry_msgs/Pose[] poses"
    ),
    "foxglove_msgs/Color": "float64 r; float64 g; float64 b; float64 a",
    "foxglove_msgs/KeyValuePair": "string key; string value",
    "foxglove_msgs/ArrowPrimitive": (
        "geometry_msgs/Pose pose; float64 shaft_length; float64 shaft_diameter; "
        "float64 head_length; float64 head_diameter; foxglove_msgs/Color color"
    ),
    "foxglove_msgs/CubePrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; foxglove_msgs/Color color"
    ),
    "foxglove_msgs/SpherePrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; foxglove_msgs/Color color"
    ),
    "foxglove_msgs/CylinderPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 size; float64 bottom_scale; "
        "float64 top_scale; foxglove_msgs/Color color"
    ),
    "foxglove_msgs/LinePrimitive": (
        "uint8 type; geometry_msgs/Pose pose; float64 thickness; bool scale_invariant; "
        "geometry_msgs/Point[] points; foxglove_msgs/Color color; foxglove_msgs/Color[] colors; "
        "uint32[] indices"
    ),
    "foxglove_msgs/TriangleListPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Point[] points; foxglove_msgs/Color color; "
        "foxglove_msgs/Color[] colors; uint32[] indices"
    ),
    "foxglove_msgs/TextPrimitive": (
        "geometry_msgs/Pose pose; bool billboard; float64 font_size; bool scale_invariant; "
        "foxglove_msgs/Color color; string text"
    ),
    "foxglove_msgs/ModelPrimitive": (
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; foxglove_msgs/Color color; "
        "bool override_color; string url; string media_type; uint8[] data"
    ),
    "foxglove_msgs/SceneEntityDeletion": (
        "builtin_interfaces/Time timestamp; uint8 type; string id"
    ),
    "foxglove_msgs/SceneEntity": (
        "builtin_interfaces/Time timestamp; string frame_id; string id; "
        "builtin_interfaces/Duration lifetime; bool frame_locked; "
        "foxglove_msgs/KeyValuePair[] metadata; foxglove_msgs/ArrowPrimitive[] arrows; "
        "foxglove_msgs/CubePrimitive[] cubes; foxglove_msgs/SpherePrimitive[] spheres; "
        "foxglove_msgs/CylinderPrimitive[] cylinders; foxglove_msgs/LinePrimitive[] lines; "
        "foxglove_msgs/TriangleListPrimitive[] triangles; foxglove_msgs/TextPrimitive[] texts; "
        "foxglove_msgs/ModelPrimitive[] models"
    ),
    "foxglove_msgs/SceneUpdate": (
        "foxglove_msgs/SceneEntityDeletion[] deletions; foxglove_msgs/SceneEntity[] entities"
    ),
    "neuroslam_msgs/Status": (
        "builtin_interfaces/Time timestamp; int64 frame; string action; int64 template; "
        "int64 experience; float64 match_error; bool lost"
    ),
}
"""Fields of each type, in the order of their bytes."""

_NUMBERS = {
    "bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "int64": "q", "float64": "d",
}  # fmt: skip


class _Field(NamedTuple):
    kind: str
    name: str
    is_list: bool


@cache
def _fields(kind: str) -> tuple[_Field, ...]:
    words = (field.split() for field in DEFINITIONS[kind].split(";"))
    return tuple(_Field(of.removesuffix("[]"), name, of.endswith("[]")) for of, name in words)


@cache
def definition(kind: str) -> str:
    """Return the definition of a type in ROS 2's form, with those of the types that it uses.

    Example:
        >>> print(definition("geometry_msgs/Point"))
        float64 x
        float64 y
        float64 z
    """
    used, to_see = [kind], [kind]
    while to_see:
        for field in _fields(to_see.pop()):
            if field.kind in DEFINITIONS and field.kind not in used:
                used.append(field.kind)
                to_see.append(field.kind)
    texts = ["\n".join(" ".join(f.split()) for f in DEFINITIONS[one].split(";")) for one in used]
    heads = ["", *(f"\n{'=' * 80}\nMSG: {one}\n" for one in used[1:])]
    return "".join(head + text for head, text in zip(heads, texts, strict=True))


def to_cdr(kind: str, message: Mapping[str, Any]) -> bytes:
    """Return the bytes of a message.

    Args:
        kind: Its type, one of :data:`DEFINITIONS`.
        message: Its fields; an array of bytes or of ``uint32`` may be NumPy's.

    Raises:
        KeyError: If the type is unknown, or a field is none of the type's.

    Example:
        >>> to_cdr("builtin_interfaces/Time", {"sec": 1}).hex()
        '000100000100000000000000'
    """
    out = bytearray()
    _put(out, kind, message)
    return b"\x00\x01\x00\x00" + bytes(out)


def _put(out: bytearray, kind: str, value: Any) -> None:  # noqa: ANN401
    code = _NUMBERS.get(kind)
    if code is not None:
        size = struct.calcsize(f"<{code}")
        out += bytes(-len(out) % size)
        out += struct.pack(f"<{code}", value or 0)
    elif kind == "string":
        text = (value or "").encode() + b"\0"
        _put(out, "uint32", len(text))
        out += text
    else:
        fields = _fields(kind)
        value = value or {}
        if unknown := value.keys() - {field.name for field in fields}:
            raise KeyError(f"{kind} has no field {min(unknown)!r}")
        for field in fields:
            item = value.get(field.name)
            if field.is_list:
                _put_list(out, field.kind, () if item is None else item)
            else:
                _put(out, field.kind, item)


def _put_list(out: bytearray, kind: str, items: Any) -> None:  # noqa: ANN401
    _put(out, "uint32", len(items))
    if kind == "uint8":
        out += bytes(items)
        return
    for item in items:
        _put(out, kind, item)


def stamp_of(time_s: float) -> dict[str, int]:
    """Return a time of ROS 2, whose seconds end in 2038.

    Example:
        >>> stamp_of(1.25)
        {'sec': 1, 'nanosec': 250000000}
    """
    whole = math.floor(time_s)
    fraction = min(round((time_s - whole) * 1e9), 999_999_999)
    return {"sec": min(max(whole, -(2**31)), 2**31 - 1), "nanosec": fraction}


def pose_of(pose: Pose, z_m: float = 0.0) -> dict[str, Any]:
    """Return an upright pose as position and quaternion.

    Example:
        >>> pose_of(Pose(1.0, 2.0, 0.0))["orientation"]
        {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
    """
    half = 0.5 * pose.theta_rad
    return {
        "position": {"x": float(pose.x_m), "y": float(pose.y_m), "z": float(z_m)},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def picture_of(image: np.ndarray, stamp: dict[str, int], frame_id: str) -> dict[str, Any]:
    """Return a picture, RGB or grey, as a JPEG message."""
    data = jpeg(image)
    return {"timestamp": stamp, "frame_id": frame_id, "format": "jpeg", "data": data}


def jpeg(image: np.ndarray) -> bytes:
    """Return a picture, RGB or grey, as a JPEG file."""
    bgr = image if image.ndim == 2 else image[:, :, ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", np.ascontiguousarray(bgr), options)[1].tobytes()


def activity_of(layer: np.ndarray, stamp: dict[str, int]) -> dict[str, Any]:
    """Return the activity of cells as a PNG message; white is the largest.

    Args:
        layer: ``(h, w)``, or ``uint8``, ``(h, w, 3)``, RGB.
        stamp: Its time.
    """
    if layer.ndim == 2:
        largest = float(np.nanmax(layer)) or 1.0
        layer = np.clip(255.0 * np.nan_to_num(layer) / largest, 0.0, 255.0)
    else:
        layer = layer[:, :, ::-1]
    data = cv2.imencode(".png", np.ascontiguousarray(layer.astype(np.uint8)))[1].tobytes()
    return {"timestamp": stamp, "frame_id": "cells", "format": "png", "data": data}


def graph_of(
    poses: np.ndarray, links: Links, stamp: dict[str, int], heights_m: np.ndarray | None = None
) -> dict[str, Any]:
    """Return experiences and links as a scene: a list of lines, and a sphere each experience.

    Args:
        poses: Of the experiences, ``(n, 3)``.
        links: Between them.
        stamp: The time.
        heights_m: Of the experiences, ``(n,)``; ``None``: 0.
    """
    z = np.zeros(len(poses)) if heights_m is None else heights_m
    ends = np.column_stack([links.source, links.target]).reshape(-1)
    size = 0.3 * max(link_length(links), 1e-3)
    lines = {
        "type": 2,  # pairs of points
        "pose": pose_of(Pose(0.0, 0.0, 0.0)),
        "thickness": 1.5,
        "scale_invariant": True,
        "points": [
            {"x": x, "y": y, "z": up}
            for (x, y), up in zip(poses[ends, :2].tolist(), z[ends].tolist(), strict=True)
        ],
        "color": {"r": 0.12, "g": 0.47, "b": 0.71, "a": 1.0},
    }
    spheres = [
        {
            "pose": pose_of(Pose(*row), up),
            "size": {"x": size, "y": size, "z": size},
            "color": {"r": 0.9, "g": 0.45, "b": 0.1, "a": 1.0},
        }
        for row, up in zip(poses.tolist(), z.tolist(), strict=True)
    ]
    entity = {
        "timestamp": stamp,
        "frame_id": FRAME_ID,
        "id": "graph",
        "lines": [lines],
        "spheres": spheres,
    }
    return {"entities": [entity]}


def path_of(
    poses: np.ndarray, stamp: dict[str, int], heights_m: np.ndarray | None = None
) -> dict[str, Any]:
    """Return poses, ``(n, 3)``, with their heights if they are known, as a path."""
    z = np.zeros(len(poses)) if heights_m is None else heights_m
    track = [pose_of(Pose(*row), up) for row, up in zip(poses.tolist(), z.tolist(), strict=True)]
    return {"timestamp": stamp, "frame_id": FRAME_ID, "poses": track}


def link_length(links: Links) -> float:
    """Return the median length of the links in metres; 1 without links."""
    return float(np.median(links.distance_m)) if len(links.distance_m) else 1.0
