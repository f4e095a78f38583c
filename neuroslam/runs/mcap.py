"""A run as an MCAP file with Foxglove's schemas, for Foxglove and other viewers; extra ``mcap``.

===========  ============================  =====================================================
``/camera``  ``foxglove.CompressedImage``  the picture of a frame, JPEG
``/pose``    ``foxglove.PoseInFrame``      pose on the map at that time
``/cells``   ``foxglove.CompressedImage``  activity of the cells that lead, PNG, every tenth frame
``/status``  ``neuroslam.Status``          action, template, experience, match error
``/graph``   ``foxglove.SceneUpdate``      experiences and links, at growing intervals and the end
``/path``    ``foxglove.PosesInFrame``     path on the finished map, at the end
===========  ============================  =====================================================

Messages are JSON; the frame is ``map``. Times are those of the source.
"""

import base64
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from neuroslam.errors import ConfigError, RunError
from neuroslam.geometry import compose_poses
from neuroslam.runs.recording import Recorder
from neuroslam.state.answers import pictures_of
from neuroslam.types import NO_EXPERIENCE, Frame, Pose, StepResult

if TYPE_CHECKING:
    from neuroslam.brain import NavigationBrain

CELLS_EVERY, FIRST_GRAPH = 10, 50
"""Frames between two pictures of the cells, and until the first graph; the intervals double."""

_JPEG_QUALITY = 80
_FRAME = "map"
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_XYZ = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
_XYZW = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyzw"}}
_POSE = {"type": "object", "properties": {"position": _XYZ, "orientation": _XYZW}}
_RGBA = {"type": "object", "properties": {letter: {"type": "number"} for letter in "rgba"}}
_TEXT, _NUMBER, _FLAG = {"type": "string"}, {"type": "number"}, {"type": "boolean"}
_LIST: dict[str, Any] = {"type": "array"}
_LINES = {
    "type": "object",
    "properties": {
        "type": {"type": "integer"},
        "pose": _POSE,
        "thickness": _NUMBER,
        "scale_invariant": _FLAG,
        "points": _LIST | {"items": _XYZ},
        "color": _RGBA,
        "colors": _LIST | {"items": _RGBA},
        "indices": _LIST | {"items": {"type": "integer"}},
    },
}
_SPHERE = {"type": "object", "properties": {"pose": _POSE, "size": _XYZ, "color": _RGBA}}
_ENTITY = {
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "id": _TEXT,
        "lifetime": _TIME,
        "frame_locked": _FLAG,
        "metadata": _LIST | {"items": {"type": "object"}},
        "arrows": _LIST | {"items": {"type": "object"}},
        "cubes": _LIST | {"items": {"type": "object"}},
        "spheres": _LIST | {"items": _SPHERE},
        "cylinders": _LIST | {"items": {"type": "object"}},
        "lines": _LIST | {"items": _LINES},
        "triangles": _LIST | {"items": {"type": "object"}},
        "texts": _LIST | {"items": {"type": "object"}},
        "models": _LIST | {"items": {"type": "object"}},
    },
}
_IMAGE = {"data": {"type": "string", "contentEncoding": "base64"}, "format": _TEXT}
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": {"timestamp": _TIME, "frame_id": _TEXT, **_IMAGE},
    "foxglove.PoseInFrame": {"timestamp": _TIME, "frame_id": _TEXT, "pose": _POSE},
    "foxglove.PosesInFrame": {
        "timestamp": _TIME,
        "frame_id": _TEXT,
        "poses": _LIST | {"items": _POSE},
    },
    "foxglove.SceneUpdate": {
        "deletions": _LIST | {"items": {"type": "object"}},
        "entities": _LIST | {"items": _ENTITY},
    },
    "neuroslam.Status": {
        "timestamp": _TIME,
        "frame": {"type": "integer"},
        "action": _TEXT,
        "template": {"type": "integer"},
        "experience": {"type": "integer"},
        "match_error": _NUMBER,
        "lost": _FLAG,
    },
}
"""JSON schema of each message type, its properties."""

TOPICS = {
    "/camera": "foxglove.CompressedImage",
    "/pose": "foxglove.PoseInFrame",
    "/cells": "foxglove.CompressedImage",
    "/status": "neuroslam.Status",
    "/graph": "foxglove.SceneUpdate",
    "/path": "foxglove.PosesInFrame",
}
"""Message type of each channel."""


class McapRecorder(Recorder):
    """Writes a run into an MCAP file while it goes on.

    Args:
        path: The file; an existing one is replaced.

    Raises:
        ConfigError: If the extra is not installed.
        RunError: If the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.writer import Writer  # extra, imported when first used
        except ImportError:
            raise ConfigError(
                'MCAP files need the extra mcap; pip install "neuroslam[mcap]"'
            ) from None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise RunError(f"{path}: cannot be written ({error.strerror or error})") from None
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="neuroslam")
        self._channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for topic, name in TOPICS.items():
            if name not in schemas:
                whole = {"title": name, "type": "object", "properties": SCHEMAS[name]}
                schemas[name] = self._writer.register_schema(
                    name, "jsonschema", json.dumps(whole).encode()
                )
            self._channels[topic] = self._writer.register_channel(topic, "json", schemas[name])
        self._seen, self._graph_due = 0, FIRST_GRAPH
        self._steps: list[tuple[int, Pose]] = []
        self._last: tuple[float, NavigationBrain] | None = None
        self._closed = False

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Write the picture, the pose and the status of a frame, and what is due."""
        time_s = float(frame.time_s)
        stamp = stamp_of(time_s)
        if frame.image is not None:
            self._write("/camera", time_s, picture_of(frame.image, stamp, "camera"))
        self._write(
            "/pose", time_s, {"timestamp": stamp, "frame_id": _FRAME, "pose": pose_of(result.pose)}
        )
        status = {
            "timestamp": stamp,
            "frame": result.frame,
            "action": result.action,
            "template": result.view.template,
            "experience": result.experience,
            "match_error": float(result.view.error),
            "lost": bool(result.lost),
        }
        self._write("/status", time_s, status)
        if self._seen % CELLS_EVERY == 0:
            self._write_cells(time_s, brain)
        self._seen += 1
        if result.experience != NO_EXPERIENCE:
            self._steps.append((result.experience, brain.map.offset))
        self._last = time_s, brain
        if self._seen >= self._graph_due:
            self._graph_due *= 2
            self._write("/graph", time_s, graph_of(brain, stamp))

    def _write_cells(self, time_s: float, brain: "NavigationBrain") -> None:
        for picture in pictures_of(brain.leader).values():
            layer = np.asarray(picture[0] if isinstance(picture, tuple) else picture)
            if layer.ndim == 2:
                largest = float(np.nanmax(layer)) or 1.0
                layer = np.clip(255.0 * np.nan_to_num(layer) / largest, 0.0, 255.0)
            image = {
                "timestamp": stamp_of(time_s),
                "frame_id": "cells",
                "format": "png",
                "data": encoded(".png", layer.astype(np.uint8)),
            }
            self._write("/cells", time_s, image)
            return

    def _write(self, topic: str, time_s: float, message: dict[str, Any]) -> None:
        at_ns = max(round(time_s * 1e9), 0)
        data = json.dumps(message).encode()
        self._writer.add_message(self._channels[topic], at_ns, data, at_ns)

    def close(self) -> None:
        """Write the finished graph and path, and the index of the file."""
        if self._closed:
            return
        self._closed = True
        if self._last is not None:
            time_s, brain = self._last
            stamp = stamp_of(time_s)
            self._write("/graph", time_s, graph_of(brain, stamp))
            poses = brain.map.poses
            known = [(e, offset) for e, offset in self._steps if e < len(poses)]
            path = np.empty((0, 3))
            if known:
                ids, offsets = zip(*known, strict=True)
                path = compose_poses(poses[list(ids)], np.array(offsets))
            track = [pose_of(Pose(*row)) for row in path.tolist()]
            self._write("/path", time_s, {"timestamp": stamp, "frame_id": _FRAME, "poses": track})
        self._writer.finish()
        self._file.close()


def stamp_of(time_s: float) -> dict[str, int]:
    """Return a time as Foxglove writes it.

    Example:
        >>> stamp_of(1.25)
        {'sec': 1, 'nsec': 250000000}
    """
    whole = math.floor(time_s)
    return {"sec": whole, "nsec": min(round((time_s - whole) * 1e9), 999_999_999)}


def pose_of(pose: Pose) -> dict[str, Any]:
    """Return a pose of the plane as position and quaternion.

    Example:
        >>> pose_of(Pose(1.0, 2.0, 0.0))["orientation"]
        {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}
    """
    half = 0.5 * pose.theta_rad
    return {
        "position": {"x": float(pose.x_m), "y": float(pose.y_m), "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def picture_of(image: np.ndarray, stamp: dict[str, int], frame_id: str) -> dict[str, Any]:
    """Return a picture, RGB or grey, as a JPEG message."""
    bgr = image if image.ndim == 2 else image[:, :, ::-1]
    data = encoded(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return {"timestamp": stamp, "frame_id": frame_id, "format": "jpeg", "data": data}


def encoded(suffix: str, image: np.ndarray, options: list[int] | None = None) -> str:
    """Encode a picture, and that as base64."""
    return base64.b64encode(cv2.imencode(suffix, image, options or [])[1].tobytes()).decode()


def graph_of(brain: "NavigationBrain", stamp: dict[str, int]) -> dict[str, Any]:
    """Return experiences and links as a scene: a list of lines, and a sphere each experience."""
    poses, links = brain.map.poses, brain.map.links
    ends = np.column_stack([links.source, links.target]).reshape(-1)
    points = [{"x": x, "y": y, "z": 0.0} for x, y in poses[ends, :2].tolist()]
    length = float(np.median(links.distance_m)) if len(links.distance_m) else 1.0
    size = 0.3 * max(length, 1e-3)
    lines = {
        "type": 2,  # pairs of points
        "pose": pose_of(Pose(0.0, 0.0, 0.0)),
        "thickness": 1.5,
        "scale_invariant": True,
        "points": points,
        "color": {"r": 0.12, "g": 0.47, "b": 0.71, "a": 1.0},
        "colors": [],
        "indices": [],
    }
    spheres = [
        {
            "pose": pose_of(Pose(*row)),
            "size": {"x": size, "y": size, "z": size},
            "color": {"r": 0.9, "g": 0.45, "b": 0.1, "a": 1.0},
        }
        for row in poses.tolist()
    ]
    empty = ("metadata", "arrows", "cubes", "cylinders", "triangles", "texts", "models")
    entity: dict[str, Any] = {
        "timestamp": stamp,
        "frame_id": _FRAME,
        "id": "graph",
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": False,
        **{name: [] for name in empty},
        "lines": [lines],
        "spheres": spheres,
    }
    return {"deletions": [], "entities": [entity]}
