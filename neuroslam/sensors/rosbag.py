"""ROS 1 and ROS 2 bags: camera, wheel odometry, laser scanner; needs the extra ``rosbag``.

``drive.bag``, a ``.db3`` or ``.mcap`` file, or a folder with ``metadata.yaml``. One topic of each
kind is read, chosen by type, content and name (:mod:`neuroslam.sensors.bag_topics`), or the one
named: ``drive.bag?image=/front&odometry=/wheels&scan=/laser``. ``notes`` of the source lists the
topics and the choice. Motion is the twist of the odometry, or the change of its poses where the
twist does not agree with them; ``motion=twist`` or ``motion=poses`` decides otherwise.
"""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np

from neuroslam.errors import BadFrame, NeuroslamError, SourceError, did_you_mean
from neuroslam.sensors.bag_images import grey_of
from neuroslam.sensors.bag_odometry import OdometrySample, motion_between, odometry_sample
from neuroslam.sensors.bag_topics import (
    KINDS,
    Candidate,
    candidates,
    choose,
    messages_of,
    note_of,
    time_of,
)
from neuroslam.sensors.full_turn import full_turn
from neuroslam.sensors.images import require_shape
from neuroslam.sensors.pixels import PixelScale
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.sensors.streams import Streams
from neuroslam.sensors.tracks import time_text
from neuroslam.types import Frame, GreyRule, Velocity

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
_MOTION = ("twist", "poses")


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: by its suffix, or a folder by its ``metadata.yaml``."""
    return path.name.lower().endswith(BAG_SUFFIXES) or (path / "metadata.yaml").is_file()


def open_bag(path: Path, topics: dict[str, str] | None = None, grey: GreyRule = "luma") -> Source:
    """Open a bag: its camera, its odometry, or both merged by time.

    Args:
        path: File or folder.
        topics: Topic by kind (see :data:`~neuroslam.sensors.bag_topics.KINDS`), and ``motion``, the
            part of odometry that is used, ``twist`` or ``poses``; by default chosen by content.
        grey: How colour becomes grey.

    Raises:
        SourceError: If ``rosbags`` is not installed, the bag is damaged, or it has no topic that
            can be used.
    """
    topics = dict(topics or {})
    options = (*KINDS, "motion")
    if unknown := set(topics) - set(options):
        raise SourceError(
            f"{path}: unknown option {min(unknown)!r}; expected one of {', '.join(options)}"
            f"{did_you_mean(min(unknown), options)}"
        )
    part = topics.pop("motion", None)
    if part is not None and part not in _MOTION:
        raise SourceError(f"{path}: motion is {part!r}; expected twist or poses")
    with _opened(path) as reader:
        msgtypes = {c.topic: c.msgtype for c in reader.connections}
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        span_s = reader.start_time * 1e-9, (reader.end_time - 1) * 1e-9  # the end is not in it
        found = {kind: candidates(reader, kind) for kind in KINDS}
        chosen = {
            kind: choose(path, kind, topics.get(kind), found[kind], msgtypes) for kind in KINDS
        }
    if chosen["image"] is None and chosen["odometry"] is None:
        raise SourceError(_nothing(path, found, msgtypes))
    notes = tuple(
        f"{path}: {note}" for kind in KINDS if (note := note_of(kind, chosen[kind], found[kind]))
    )
    motion: BagMotion | None = None
    camera: BagCamera | None = None
    scan = chosen["scan"]
    if (one := chosen["odometry"]) is not None:
        use = part or (one.check.use if one.check else "twist")
        motion = BagMotion(
            path, one.topic, scan and scan.topic, counts[one.topic], by_poses=use == "poses"
        )
        motion.notes = notes
    if (one := chosen["image"]) is not None:
        camera = BagCamera(path, one.topic, counts[one.topic], grey, one.scale)
        camera.choices = () if motion is not None else notes
    for part_of in (camera, motion):
        if part_of is not None:
            part_of.span_s = span_s
    if camera is not None and motion is not None:
        return Streams(camera, motion)
    return cast(Source, camera or motion)  # one is there, as checked above


def _nothing(path: Path, found: dict[str, list[Candidate]], msgtypes: dict[str, str]) -> str:
    unusable = [note_of(kind, None, found[kind]) for kind in ("image", "odometry") if found[kind]]
    readable = next((one.topic for one in found["image"] if one.readable), None)
    if unusable:
        hint = f"; to read it all the same: {path}?image={readable}" if readable else ""
        return f"{path}: has no images or odometry that can be used; {'; '.join(unusable)}{hint}"
    return f"{path}: contains neither images nor odometry; its topics are {_listed(msgtypes)}"


def _listed(topics: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({msgtype})" for topic, msgtype in sorted(topics.items())) or "none"


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SourceError(
            f'{path}: is a ROS bag; to read it, pip install "neuroslam[rosbag]"'
        ) from None
    try:
        kinds = get_typestore(Stores.ROS2_HUMBLE if path.suffix != ".bag" else Stores.ROS1_NOETIC)
        with AnyReader([path], default_typestore=kinds) as reader:
            yield reader
    except NeuroslamError:  # about a topic or a frame, not about the file
        raise
    except Exception as error:  # the parser raises many types for damaged bytes
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SourceError(
            f"{path}: is damaged or incomplete ({reason}); expected a ROS bag"
        ) from None


class _BagTopic(Source):
    """Messages of some topics, in order of time; each message of the first topic is a frame.

    Attributes:
        span_s: First and last time of reception in the whole bag; ``None``: unknown.
    """

    span_s: tuple[float, float] | None = None

    def __init__(self, path: Path, topics: tuple[str, ...], n_messages: int) -> None:
        self.path, self.topics = path, topics
        self.name = f"{path}: {topics[0]}"
        self.n_frames = n_messages
        self.frame_rate_hz = None

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        self._begin()
        index, last_s = 0, -np.inf
        with _opened(self.path) as reader:
            for topic, received_ns, message in messages_of(reader, self.topics):
                if stop is not None and index >= stop:
                    return
                is_frame = topic == self.topics[0]
                try:
                    if message is None:
                        raise BadFrame(
                            f"{self.name}: frame {index}: its message"
                            f"{'' if is_frame else f' of {topic}'} is damaged"
                        )
                    if not is_frame:
                        self._update(message)
                        continue
                    time_s = time_of(message, received_ns)
                    if not time_s > last_s:
                        raise BadFrame(
                            f"{self.name}: frame {index}: its time {time_text(time_s)} is not "
                            f"after {time_text(last_s)}; times must rise"
                        )
                    frame = self._frame(index, time_s, message)
                    last_s = time_s
                except BadFrame as error:
                    if index >= start:
                        if on_bad_frame is None:
                            raise
                        on_bad_frame(error)
                else:
                    if index >= start:
                        yield frame
                index += is_frame

    def _begin(self) -> None:
        """Reset the state of an earlier reading."""

    @abstractmethod
    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        """Make a frame of a message of the first topic."""

    def _update(self, message: Any) -> None:  # noqa: ANN401
        """Process a message of another topic than the first."""


class BagCamera(_BagTopic):
    """The images of one topic, in grey.

    Attributes:
        choices: Notes on the choice of the topic.
    """

    def __init__(
        self,
        path: Path,
        topic: str,
        n_messages: int,
        grey: GreyRule = "luma",
        scale: PixelScale | None = None,
    ) -> None:
        super().__init__(path, (topic,), n_messages)
        self.grey: GreyRule = grey
        self.scale = scale or PixelScale()
        self.choices: tuple[str, ...] = ()
        self._begin()

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        """The choice of the topic, and how images of more than 8 bits are scaled."""
        note = self.scale.note()
        return (*self.choices, f"{self.name}: {note}") if note else self.choices

    def _begin(self) -> None:
        self.shape: tuple[int, ...] | None = None

    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        try:
            image = grey_of(message, self.grey, self.scale, index)
        except BadFrame as error:
            raise BadFrame(f"{self.name}: frame {index}: {error}") from None
        self.shape = self.shape or image.shape
        require_shape(image, self.shape, self.name, index)
        return Frame(index, time_s, image=image)


class BagMotion(_BagTopic):
    """The measured motion of one topic, and the latest scan of another.

    Args:
        path: File or folder.
        topic: Topic of odometry.
        scan: Topic of scans; ``None``: no ranges.
        n_messages: Number of messages of odometry.
        by_poses: Motion is the change of the poses, not the twist.
    """

    def __init__(
        self, path: Path, topic: str, scan: str | None, n_messages: int, by_poses: bool = False
    ) -> None:
        super().__init__(path, (topic,) if scan is None else (topic, scan), n_messages)
        self.by_poses = by_poses
        self._begin()

    def _begin(self) -> None:
        self.ranges: np.ndarray | None = None
        self._before: OdometrySample | None = None

    def _update(self, message: Any) -> None:  # noqa: ANN401
        try:
            self.ranges = full_turn(message.ranges, message.angle_min, message.angle_increment,
                                    message.range_min, message.range_max)  # fmt: skip
        except BadFrame as error:
            raise BadFrame(f"{self.path}: {self.topics[1]}: {error}") from None

    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        now = odometry_sample(message, time_s)
        if self.by_poses:
            if not np.isfinite(now[:5]).all():
                raise BadFrame(
                    f"{self.name}: frame {index}: its pose is x = {now.x_m} m, y = {now.y_m} m, "
                    f"heading {now.heading_rad} rad; expected finite numbers"
                )
            before, self._before = self._before or now._replace(time_s=time_s - 1.0), now
            return Frame(index, time_s, velocity=motion_between(before, now), ranges=self.ranges)
        v, w = now.vx_m_s, now.w_rad_s
        if not (np.isfinite(v) and np.isfinite(w)):
            raise BadFrame(
                f"{self.name}: frame {index}: v = {v} m/s, w = {w} rad/s; expected finite numbers"
            )
        return Frame(index, time_s, velocity=Velocity(v, w), ranges=self.ranges)
