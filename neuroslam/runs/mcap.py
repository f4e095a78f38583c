"""A run as an MCAP file with Foxglove's schemas, for Foxglove, ROS 2 and others; extra ``mcap``.

===========  =================================  ================================================
``/camera``  ``foxglove_msgs/CompressedImage``  the picture of a frame, JPEG
``/pose``    ``foxglove_msgs/PoseInFrame``      pose on the map
``/cells``   ``foxglove_msgs/CompressedImage``  activity of the cells that lead, PNG
``/status``  ``neuroslam_msgs/Status``          action, template, experience, match error
``/graph``   ``foxglove_msgs/SceneUpdate``      experiences and links
``/path``    ``foxglove_msgs/PosesInFrame``     path on the finished map
===========  =================================  ================================================

Messages are CDR under the profile ``ros2``; the frame is ``map``. Times are those of the source.
While a run goes on, poses are those that were estimated then, ``/cells`` follows every tenth frame,
``/graph`` at growing intervals and at the end, ``/path`` at the end. Of a finished run, poses,
graph and path are those of the finished map, the latter two at its first time, and a frame is lost
if it has no place on that map.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.errors import ConfigError, RunError, SourceError
from neuroslam.geometry import compose_poses
from neuroslam.runs.files import brain_file, more_columns
from neuroslam.runs.foxglove import (
    FRAME_ID,
    activity_of,
    definition,
    graph_of,
    path_of,
    picture_of,
    pose_of,
    stamp_of,
    to_cdr,
)
from neuroslam.runs.heights import frame_heights, map_heights
from neuroslam.runs.reading import read_actions, read_frames, read_plan, read_trace, trajectory
from neuroslam.runs.recording import Recorder
from neuroslam.sensors import open_source
from neuroslam.state.activity import ACTIVITY, ActivityLog
from neuroslam.state.answers import pictures_of
from neuroslam.state.files import write_atomically
from neuroslam.types import NO_EXPERIENCE, Frame, Pose, StepResult

if TYPE_CHECKING:
    from neuroslam.brain import NavigationBrain

CELLS_EVERY, FIRST_GRAPH = 10, 50
"""Frames between two pictures of the cells, and until the first graph; the intervals double."""

TOPICS = {
    "/camera": "foxglove_msgs/CompressedImage",
    "/pose": "foxglove_msgs/PoseInFrame",
    "/cells": "foxglove_msgs/CompressedImage",
    "/status": "neuroslam_msgs/Status",
    "/graph": "foxglove_msgs/SceneUpdate",
    "/path": "foxglove_msgs/PosesInFrame",
}
"""Message type of each channel."""


class McapFile:
    """An MCAP file that is written message by message.

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
        self._writer.start(profile="ros2", library="neuroslam")
        self._channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for topic, kind in TOPICS.items():
            if kind not in schemas:
                name = kind.replace("/", "/msg/")
                text = definition(kind).encode()
                schemas[kind] = self._writer.register_schema(name, "ros2msg", text)
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schemas[kind])

    def write(self, topic: str, time_s: float, message: dict[str, Any]) -> None:
        """Append a message of one of :data:`TOPICS`."""
        at_ns = max(round(time_s * 1e9), 0)
        data = to_cdr(TOPICS[topic], message)
        self._writer.add_message(self._channels[topic], at_ns, data, at_ns)

    def write_pose(self, time_s: float, pose: Pose, z_m: float = 0.0) -> None:
        """Append a pose on the map."""
        there = pose_of(pose, z_m)
        message = {"timestamp": stamp_of(time_s), "frame_id": FRAME_ID, "pose": there}
        self.write("/pose", time_s, message)

    def close(self) -> None:
        """Write the index of the file."""
        self._writer.finish()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class McapRecorder(Recorder):
    """Writes a run into an MCAP file while it goes on.

    Args:
        path: The file; an existing one is replaced.

    Raises:
        ConfigError: If the extra is not installed.
        RunError: If the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = McapFile(path)
        self._seen, self._graph_due = 0, FIRST_GRAPH
        self._steps: list[tuple[int, tuple[float, ...]]] = []  # x, y, heading, and above it
        self._last: tuple[float, NavigationBrain] | None = None
        self._closed = False

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Write the picture, the pose and the status of a frame, and what is due."""
        time_s = float(frame.time_s)
        stamp = stamp_of(time_s)
        if frame.image is not None:
            self._file.write("/camera", time_s, picture_of(frame.image, stamp, "camera"))
        up = more_columns(brain)
        self._file.write_pose(time_s, result.pose, up.get("z_m", 0.0))
        status = {
            "timestamp": stamp,
            "frame": result.frame,
            "action": result.action,
            "template": result.view.template,
            "experience": result.experience,
            "match_error": float(result.view.error),
            "lost": bool(result.lost),
        }
        self._file.write("/status", time_s, status)
        if self._seen % CELLS_EVERY == 0 and (layer := _picture(brain)) is not None:
            self._file.write("/cells", time_s, activity_of(layer, stamp))
        self._seen += 1
        if result.experience != NO_EXPERIENCE:
            offset = (*brain.map.offset, up.get("rise_m", 0.0))
            self._steps.append((result.experience, offset))
        self._last = time_s, brain
        if self._seen >= self._graph_due:
            self._graph_due *= 2
            graph = graph_of(brain.map.poses, brain.map.links, stamp, map_heights(brain))
            self._file.write("/graph", time_s, graph)

    def close(self) -> None:
        """Write the finished graph and path, and the index of the file."""
        if self._closed:
            return
        self._closed = True
        if self._last is not None:
            time_s, brain = self._last
            stamp, poses = stamp_of(time_s), brain.map.poses
            heights = map_heights(brain)
            self._file.write("/graph", time_s, graph_of(poses, brain.map.links, stamp, heights))
            known = [(e, offset) for e, offset in self._steps if e < len(poses)]
            path, up = np.empty((0, 3)), None
            if known:
                ids, offsets = zip(*known, strict=True)
                path = compose_poses(poses[list(ids)], np.array(offsets)[:, :3])
                if heights is not None:
                    up = heights[list(ids)] + np.array(offsets)[:, 3]
            self._file.write("/path", time_s, path_of(path, stamp, up))
        self._file.close()


def export_mcap(run: str | Path, to: str | Path, source: str | Path | None = None) -> list[str]:
    """Write a finished run as an MCAP file, whole or not at all.

    ``/cells`` has the samples of ``--record cells``, or, without them, the last state alone.

    Args:
        run: Folder of the run.
        to: File to write; an existing one is replaced.
        source: Source of the pictures; default: that of the run.

    Returns:
        What is left out, and why, a line each: the pictures, if a default source is no longer
        there or has none.

    Raises:
        RunError, CheckpointError: If the run cannot be read.
        SourceError: If ``source`` is given and cannot be opened.
        ConfigError: If the extra is not installed.
    """
    run, to = Path(run), Path(to)
    if not run.is_dir():
        raise RunError(f"{run}: is not the folder of a run, which mcap needs")
    brain = load_brain(brain_file(run))
    rows = brain.clock.frames_seen
    frames, actions, trace = read_frames(run, rows), read_actions(run, rows), read_trace(run, rows)
    brain = brain.largest
    poses, up = trajectory(brain, trace), frame_heights(brain, trace, run)
    known = [all(map(math.isfinite, pose)) for pose in poses.tolist()]
    times_s = frames["time_s"]
    notes: list[str] = []

    def write(path: Path) -> None:
        with McapFile(path) as file:
            begin = stamp_of(float(times_s[0]))
            graph = graph_of(brain.map.poses, brain.map.links, begin, map_heights(brain))
            file.write("/graph", float(times_s[0]), graph)
            driven = path_of(poses[known], begin, None if up is None else up[known])
            file.write("/path", float(times_s[0]), driven)
            pictures = _pictures(run, brain, source, notes)
            cells = _cells(run, brain, float(times_s[-1]))
            picture, sample = next(pictures, None), next(cells, None)
            for i, number in enumerate(frames["frame"].astype(int).tolist()):
                time_s = float(times_s[i])
                stamp = stamp_of(time_s)
                while picture is not None and picture[0] < number:
                    picture = next(pictures, None)
                if picture is not None and picture[0] == number:
                    file.write("/camera", time_s, picture_of(picture[1], stamp, "camera"))
                if known[i]:
                    z_m = 0.0 if up is None else float(up[i])
                    file.write_pose(time_s, Pose(*poses[i].tolist()), z_m)
                status = {
                    "timestamp": stamp,
                    "frame": number,
                    "action": str(actions[i]),
                    "template": int(frames["template"][i]),
                    "experience": int(frames["experience"][i]),
                    "match_error": float(frames["match_error"][i]),
                    "lost": not known[i],
                }
                file.write("/status", time_s, status)
                while sample is not None and sample[0] <= time_s:
                    file.write("/cells", time_s, activity_of(sample[1], stamp))
                    sample = next(cells, None)

    write_atomically(to, write)
    return notes


def _pictures(
    run: Path, brain: "NavigationBrain", source: str | Path | None, notes: list[str]
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield number and picture of every frame that has one, and note if there are none."""
    plan = read_plan(run)
    name, n = plan.source if source is None else source, 0
    try:
        opened = open_source(name, brain.config.frame_rate_hz, brain.config.view.grey)
        for frame in opened.frames(plan.start, brain.clock.frame + 1, lambda _: None):
            if frame.image is not None:
                n += 1
                yield frame.index, frame.image
    except SourceError as error:
        if source is not None:
            raise
        notes.append(f"{n or 'no'} pictures: {error}; give the source with --source")
        return
    if not n:
        notes.append(f"no pictures: {name} has none")


def _cells(run: Path, brain: "NavigationBrain", end_s: float) -> Iterator[tuple[float, np.ndarray]]:
    """Yield time and picture of the recorded activity of the cells that lead."""
    now = _picture(brain)
    name, rates = next(iter(brain.leader.recorded().items()), ("", np.zeros(0)))
    if (run / ACTIVITY).is_dir() and name in (log := ActivityLog.open(run / ACTIVITY)).names:
        for time_s, row in zip(log.time_s.tolist(), log[name], strict=True):
            yield time_s, _folded(row, None if now is None else now.shape, len(rates))
    elif now is not None:
        yield end_s, now


def _folded(row: np.ndarray, shape: tuple[int, ...] | None, n: int) -> np.ndarray:
    """Return the activity of cells as a picture.

    Cells that fill layers of the shape of the population's own picture are summed over the layers;
    others are laid in rows of a square.
    """
    if shape is not None and len(shape) == 2 and n and n % math.prod(shape) == 0:
        layers: np.ndarray = row[:n].reshape(-1, *shape).sum(axis=0)
        return layers
    side = math.ceil(math.sqrt(max(len(row), 1)))
    return np.pad(row, (0, side * math.ceil(len(row) / side) - len(row))).reshape(-1, side)


def _picture(brain: "NavigationBrain") -> np.ndarray | None:
    """Return the first picture of the cells that lead, if they draw any."""
    for picture in pictures_of(brain.leader).values():
        return np.asarray(picture[0] if isinstance(picture, tuple) else picture)
    return None
