"""ROS 1 and ROS 2 bags: camera, wheel odometry, laser scanner; needs the extra ``rosbag``.

``drive.bag``, a ``.db3`` or ``.mcap`` file, or a folder with ``metadata.yaml``. The first topic of
each kind is read, or the one named: ``drive.bag?image=/front&odometry=/wheels&scan=/laser``.
"""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from neuroslam.errors import BadFrame, SourceError, did_you_mean
from neuroslam.geometry import TWO_PI, wrap_angles
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.images import decode_grey, require_shape
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.sensors.streams import Streams
from neuroslam.sensors.tracks import time_text
from neuroslam.types import Frame, GreyRule, Velocity

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
KINDS = {
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "odometry": ("nav_msgs/msg/Odometry",),
    "scan": ("sensor_msgs/msg/LaserScan",),
}
N_RANGES = 360
"""Number of bearings to which a scan is resampled, evenly over the full turn."""

_GREY = {
    "mono8": (np.uint8, 1, None),
    "8UC1": (np.uint8, 1, None),
    "mono16": (np.uint16, 1, None),
    "16UC1": (np.uint16, 1, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
    "8UC3": (np.uint8, 3, cv2.COLOR_BGR2GRAY),
    "rgb8": (np.uint8, 3, cv2.COLOR_RGB2GRAY),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2GRAY),
    "8UC4": (np.uint8, 4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2GRAY),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2GRAY_YUY2),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGB2GRAY),
}
"""For each encoding: type and number of channels of a pixel, and its conversion to luma."""

_BGR = {
    "bgra8": cv2.COLOR_BGRA2BGR,
    "8UC4": cv2.COLOR_BGRA2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "bayer_rggb8": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr8": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg8": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg8": cv2.COLOR_BayerGB2BGR,
}
"""Conversion of an encoding to three channels of colour, where it has not just those."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: by its suffix, or a folder by its ``metadata.yaml``."""
    return path.name.lower().endswith(BAG_SUFFIXES) or (path / "metadata.yaml").is_file()


def open_bag(path: Path, topics: dict[str, str] | None = None, grey: GreyRule = "luma") -> Source:
    """Open a bag: its camera, its odometry, or both merged by time.

    Args:
        path: File or folder.
        topics: Topic by kind (see ``KINDS``); by default the first of each kind.
        grey: How colour becomes grey.

    Raises:
        SourceError: If ``rosbags`` is not installed, the bag is damaged, or it lacks a topic.
    """
    topics = topics or {}
    if unknown := set(topics) - set(KINDS):
        raise SourceError(
            f"{path}: unknown option {min(unknown)!r}; expected one of {', '.join(KINDS)}"
            f"{did_you_mean(min(unknown), KINDS)}"
        )
    with _opened(path) as reader:
        available = {c.topic: c.msgtype for c in reader.connections}
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
    chosen = {kind: _choose(path, kind, topics.get(kind), available) for kind in KINDS}
    if chosen["image"] is None and chosen["odometry"] is None:
        raise SourceError(
            f"{path}: contains neither images nor odometry; its topics are {_listed(available)}"
        )
    motion: BagMotion | None = None
    camera: BagCamera | None = None
    if (topic := chosen["odometry"]) is not None:
        motion = BagMotion(path, topic, chosen["scan"], counts[topic])
    if (topic := chosen["image"]) is not None:
        camera = BagCamera(path, topic, counts[topic], grey)
    if camera is not None and motion is not None:
        return Streams(camera, motion)
    return cast(Source, camera or motion)  # one is there, as checked above


def _choose(path: Path, kind: str, wanted: str | None, available: dict[str, str]) -> str | None:
    fitting = sorted(topic for topic, msgtype in available.items() if msgtype in KINDS[kind])
    if wanted is None:
        return fitting[0] if fitting else None
    if wanted not in fitting:
        problem = f"has {available[wanted]}" if wanted in available else "is not in the bag"
        raise SourceError(
            f"{path}: topic {wanted!r} {problem}; topics for {kind}: {', '.join(fitting) or 'none'}"
        )
    return wanted


def _listed(topics: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({msgtype})" for topic, msgtype in sorted(topics.items())) or "none"


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise SourceError(
            f'{path}: is a ROS bag; to read it, pip install "neuroslam[rosbag]"'
        ) from None
    try:
        kinds = get_typestore(Stores.ROS2_HUMBLE if path.suffix != ".bag" else Stores.ROS1_NOETIC)
        with AnyReader([path], default_typestore=kinds) as reader:
            yield reader
    except (AnyReaderError, OSError, KeyError, ValueError, AssertionError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SourceError(
            f"{path}: is damaged or incomplete ({reason}); expected a ROS bag"
        ) from None


class _BagTopic(Source):
    """Messages of some topics, in order of time; each message of the first topic is a frame."""

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
            wanted = [c for c in reader.connections if c.topic in self.topics]
            for connection, received_ns, data in reader.messages(connections=wanted):
                if stop is not None and index >= stop:
                    return
                message = reader.deserialize(data, connection.msgtype)
                time_s = _time_s(message, received_ns)
                if connection.topic != self.topics[0]:
                    self._update(message)
                    continue
                try:
                    frame = self._frame(index, time_s, message)
                    if not time_s > last_s:
                        raise BadFrame(
                            f"{self.name}: frame {index}: its time {time_text(time_s)} is not "
                            f"after {time_text(last_s)}; times must rise"
                        )
                    last_s = time_s
                except BadFrame as error:
                    if index >= start:
                        if on_bad_frame is None:
                            raise
                        on_bad_frame(error)
                else:
                    if index >= start:
                        yield frame
                index += 1

    def _begin(self) -> None:
        """Reset the state of an earlier reading."""

    @abstractmethod
    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        """Make a frame of a message of the first topic."""

    def _update(self, message: Any) -> None:  # noqa: ANN401
        """Process a message of another topic than the first."""


class BagCamera(_BagTopic):
    """The images of one topic, in grey."""

    def __init__(self, path: Path, topic: str, n_messages: int, grey: GreyRule = "luma") -> None:
        super().__init__(path, (topic,), n_messages)
        self.grey: GreyRule = grey
        self._begin()

    def _begin(self) -> None:
        self.shape: tuple[int, ...] | None = None

    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        image = _grey(message, self.name, index, self.grey)
        self.shape = self.shape or image.shape
        require_shape(image, self.shape, self.name, index)
        return Frame(index, time_s, image=image)


class BagMotion(_BagTopic):
    """The measured motion of one topic, and the latest scan of another."""

    def __init__(self, path: Path, topic: str, scan: str | None, n_messages: int) -> None:
        super().__init__(path, (topic,) if scan is None else (topic, scan), n_messages)
        self._begin()

    def _begin(self) -> None:
        self.ranges: np.ndarray | None = None

    def _update(self, message: Any) -> None:  # noqa: ANN401
        self.ranges = full_turn(message.ranges, message.angle_min, message.angle_increment,
                                message.range_min, message.range_max)  # fmt: skip

    def _frame(self, index: int, time_s: float, message: Any) -> Frame:  # noqa: ANN401
        twist = message.twist.twist
        v, w = float(twist.linear.x), float(twist.angular.z)
        if not (np.isfinite(v) and np.isfinite(w)):
            raise BadFrame(
                f"{self.name}: frame {index}: v = {v} m/s, w = {w} rad/s; expected finite numbers"
            )
        return Frame(index, time_s, velocity=Velocity(v, w), ranges=self.ranges)


def full_turn(
    ranges: np.ndarray, first_rad: float, step_rad: float, min_m: float, max_m: float
) -> np.ndarray:
    """Resample a scan to bearings evenly over the full turn.

    Args:
        ranges: Distances in metres, ``(n,)``.
        first_rad: Bearing of the first beam, positive to the left.
        step_rad: Angle from beam to beam.
        min_m: Shorter distances are invalid.
        max_m: Longer distances are invalid.

    Returns:
        Distances at ``N_RANGES`` bearings, counter-clockwise from straight ahead: that of the beam
        nearest in bearing; ``inf`` if no beam is within one step, or its distance is invalid.

    Example:
        >>> turn = full_turn(np.array([1.0, 2.0, 3.0]), -np.pi / 2, np.pi / 2, 0.1, 10.0)
        >>> turn[[270, 0, 90, 180]].tolist()
        [1.0, 2.0, 3.0, inf]
    """
    distances = np.asarray(ranges, np.float64)
    distances = np.where((distances >= min_m) & (distances <= max_m), distances, np.inf)
    bearings = np.arange(N_RANGES) * (TWO_PI / N_RANGES)
    middle = first_rad + 0.5 * step_rad * (len(distances) - 1)
    offset = wrap_angles(bearings - middle) + (middle - first_rad)
    beam = np.rint(offset / step_rad).astype(np.int64)
    covered = (beam >= 0) & (beam < len(distances))
    return np.where(covered, distances[beam.clip(0, len(distances) - 1)], np.inf)


def _time_s(message: Any, received_ns: int) -> float:  # noqa: ANN401
    stamp = message.header.stamp
    stamped = stamp.sec + stamp.nanosec * 1e-9
    return stamped if stamped > 0.0 else received_ns * 1e-9


def _grey(message: Any, name: str, index: int, rule: GreyRule) -> np.ndarray:  # noqa: ANN401
    if hasattr(message, "format"):
        image = decode_grey(bytes(message.data), rule)
        if image is None:
            raise BadFrame(f"{name}: frame {index}: its {message.format} image is corrupt")
        return image
    if message.encoding not in _GREY:
        raise BadFrame(
            f"{name}: frame {index}: encoding {message.encoding!r}; expected one of "
            f"{', '.join(_GREY)}"
        )
    kind, channels, conversion = _GREY[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    h, w, used = message.height, message.width, message.width * channels * dtype.itemsize
    data = np.asarray(message.data, np.uint8)
    if message.step < used or len(data) < h * message.step:
        raise BadFrame(
            f"{name}: frame {index}: {len(data)} bytes in rows of {message.step} for {w} x {h} px "
            f"{message.encoding}; the message is damaged"
        )
    rows = np.ascontiguousarray(data[: h * message.step].reshape(h, message.step)[:, :used])
    pixels = rows.view(dtype).reshape((h, w) if channels == 1 else (h, w, channels))
    if dtype.itemsize == 2:
        return (pixels >> 8).astype(np.uint8)
    if conversion is None:
        return pixels.copy()
    if rule == "luma":  # in one step, without rounding in between
        return cv2.cvtColor(pixels, conversion)
    to_bgr = _BGR.get(message.encoding)
    return to_grey(pixels if to_bgr is None else cv2.cvtColor(pixels, to_bgr), rule)
