"""Choice of the topics of a ROS bag by type, name and content: a camera, odometry and a scan."""

import re
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.bag_images import encoding_of, grey_of, pixels_of
from neuroslam.sensors.bag_odometry import OdometryCheck, check_odometry, odometry_sample
from neuroslam.sensors.pixels import PixelScale, spread

KINDS = {
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "odometry": ("nav_msgs/msg/Odometry",),
    "scan": ("sensor_msgs/msg/LaserScan",),
}
"""Message types of each kind of topic."""

_EXAMINED = 5  # messages of an image or scan topic
_SCALED = 16  # messages of an image topic of 16 bits
_WINDOWS, _IN_WINDOW = 16, 250  # parts of odometry, and messages of each
_FEW = 0.1  # of the messages of the largest topic of the kind
_FLAT = 2.0  # grey levels of standard deviation

_DEPTH = re.compile(r"depth|dispar|range|confidence|xyz|point_?cloud", re.IGNORECASE)
_DERIVED = re.compile(
    r"debug|dbg|annot|detect|bbox|yolo|overlay|visuali[sz]|viz|mask|segment|label|track|feature|"
    r"flow|heat_?map|salien|result",
    re.IGNORECASE,
)
_INFRARED = re.compile(r"infra|thermal|(^|[/_])ir\d*([/_]|$)", re.IGNORECASE)
_TRUTH = re.compile(r"truth|(^|[/_])gt([/_]|$)|vicon|optitrack|mocap", re.IGNORECASE)


class Candidate(NamedTuple):
    """A topic of a kind.

    Attributes:
        topic: Its name.
        about: Content in a few words.
        penalty: How ill it suits; 0: nothing speaks against it.
        against: What speaks against it.
        usable: Whether it can be read, and may be chosen unasked.
        readable: Whether it can be read if it is asked for.
        scale: Scale of the images, if it is an image topic.
        check: Twist and poses, if it is an odometry topic.
    """

    topic: str
    about: str
    penalty: int = 0
    against: str = ""
    usable: bool = True
    readable: bool = True
    scale: PixelScale | None = None
    check: OdometryCheck | None = None

    @property
    def described(self) -> str:
        """The topic with its content, and what speaks against it."""
        return f"{self.topic} ({', '.join(filter(None, (self.about, self.against)))})"


def candidates(reader: Any, kind: str) -> list[Candidate]:  # noqa: ANN401
    """Return the topics of a kind in an opened bag, the best first.

    Args:
        reader: An open ``rosbags.highlevel.AnyReader``.
        kind: ``image``, ``odometry`` or ``scan``.
    """
    examine: Callable[[Any, str, int], Candidate] = {
        "image": _image, "odometry": _odometry, "scan": _scan,
    }[kind]  # fmt: skip
    counts: dict[str, int] = {}
    for connection in reader.connections:
        if connection.msgtype in KINDS[kind]:
            count = reader.topics[connection.topic].msgcount
            counts[connection.topic] = max(counts.get(connection.topic, 0), count)
    found = []
    for topic, n in counts.items():
        if n == 0:
            found.append(Candidate(topic, "no messages", usable=False, readable=False))
            continue
        one = examine(reader, topic, n)
        if n < _FEW * max(counts.values()) and not one.penalty:
            one = one._replace(penalty=2, against="few messages")
        found.append(one)
    return sorted(found, key=lambda one: (not one.usable, one.penalty, one.topic))


def choose(
    path: Path, kind: str, wanted: str | None, found: Sequence[Candidate], msgtypes: dict[str, str]
) -> Candidate | None:
    """Choose a topic of a kind: the one asked for, or the best; ``None`` if none is usable.

    Raises:
        SourceError: If the topic that was asked for is not there, or cannot be read.
    """
    if wanted is None:
        return found[0] if found and found[0].usable else None
    others = [one for one in found if one.topic != wanted]
    for one in found:
        if one.topic == wanted and one.readable:
            return one
        if one.topic == wanted:
            listed = ", ".join(other.described for other in others) or "none"
            raise SourceError(
                f"{path}: topic {wanted!r} cannot be read: {one.against or one.about}; "
                f"other topics for {kind}: {listed}"
            )
    problem = f"has {msgtypes[wanted]}" if wanted in msgtypes else "is not in the bag"
    names = ", ".join(sorted(one.topic for one in found)) or "none"
    raise SourceError(f"{path}: topic {wanted!r} {problem}; topics for {kind}: {names}")


def note_of(kind: str, chosen: Candidate | None, found: Sequence[Candidate]) -> str:
    """Return in one line which topic of a kind was chosen, and which were not; or empty."""
    others = "; ".join(one.described for one in found if one is not chosen)
    if chosen is None:
        return f"no {kind} topic: {others}" if others else ""
    return f"{kind} topic: {chosen.described}{f'; not {others}' if others else ''}"


def messages_of(reader: Any, topics: Sequence[str], **span: int) -> Iterator[tuple[str, int, Any]]:  # noqa: ANN401
    """Yield topic, time of reception (ns) and message; ``None`` for a damaged message.

    Args:
        reader: An open ``rosbags.highlevel.AnyReader``.
        topics: Names of topics.
        span: ``start`` and ``stop``, times of reception in nanoseconds.
    """
    connections = [c for c in reader.connections if c.topic in topics]
    for connection, received_ns, data in reader.messages(connections=connections, **span):
        try:
            message = reader.deserialize(data, connection.msgtype)
        except Exception:  # the parser raises many types for damaged bytes
            message = None
        yield connection.topic, received_ns, message


def time_of(message: Any, received_ns: int) -> float:  # noqa: ANN401
    """Return the time of a message in seconds: its stamp, or that of reception without one."""
    stamp = message.header.stamp
    stamped = stamp.sec + stamp.nanosec * 1e-9
    return float(stamped) if stamped > 0.0 else received_ns * 1e-9


def _examples(reader: Any, topic: str, n: int, most: int) -> list[Any]:  # noqa: ANN401
    """Return some messages of a topic, evenly spaced in time, that are not damaged."""
    if n <= most:
        found = [message for _, _, message in messages_of(reader, [topic])]
    else:
        begin, length = reader.start_time, reader.end_time - reader.start_time
        starts = [begin + length * k // most for k in range(most)]
        each = (next(messages_of(reader, [topic], start=start), None) for start in starts)
        found = [one[2] for one in each if one is not None]
    return [message for message in found if message is not None]


def _image(reader: Any, topic: str, n: int) -> Candidate:  # noqa: ANN401
    images, pixels, fault, encoding = [], [], "", ""
    scale = PixelScale()
    for message in _examples(reader, topic, n, _EXAMINED):
        encoding = encoding or encoding_of(message)
        try:
            pixels.append(pixels_of(message))
            images.append(grey_of(message, "luma", scale))
        except BadFrame as error:
            fault = fault or str(error)
    is_depth = bool(_DEPTH.search(topic))
    if not images:
        about = ", ".join(filter(None, (encoding, counted(n, "message"))))
        against = "depth" if "32FC1" in encoding or "compressedDepth" in encoding else fault
        return Candidate(topic, about, 9, against or "damaged", usable=False, readable=False)
    h, w = images[0].shape
    about = f"{encoding}, {w} x {h} px, {counted(n, 'message')}"
    deep = pixels[0].dtype == np.uint16
    if deep:
        scale = _scale(reader, topic, n)
    one = Candidate(topic, about, scale=scale)
    grey16 = "16UC1" in encoding or (deep and images[0].ndim == pixels[0].ndim)
    if is_depth and grey16:
        return one._replace(penalty=8, against="depth", usable=False)
    if is_depth:
        return one._replace(penalty=6, against="depth by its name")
    if _DERIVED.search(topic):
        return one._replace(penalty=5, against="drawn upon or derived, by its name")
    if max(float(image.std()) for image in images) < _FLAT:
        return one._replace(penalty=4, against="no contrast")
    if "16UC1" in encoding:
        return one._replace(penalty=3, against="16UC1, perhaps depth")
    if _INFRARED.search(topic):
        return one._replace(penalty=1, against="infrared by its name")
    return one


def _scale(reader: Any, topic: str, n: int) -> PixelScale:  # noqa: ANN401
    examined = []
    for message in _examples(reader, topic, n, _SCALED):
        try:
            examined.append(pixels_of(message))
        except BadFrame:  # reported when it is read
            continue
    return PixelScale.of(one for one in examined if one.dtype == np.uint16)


def _odometry(reader: Any, topic: str, n: int) -> Candidate:  # noqa: ANN401
    if n <= _WINDOWS * _IN_WINDOW:
        spans: list[dict[str, int]] = [{}]
        most = n
    else:
        begin, length = reader.start_time, reader.end_time - reader.start_time
        spans = [{"start": begin + length * k // _WINDOWS} for k in spread(_WINDOWS)]
        most = _IN_WINDOW
    windows = [
        [
            odometry_sample(message, time_of(message, received_ns))
            for _, received_ns, message in islice(messages_of(reader, [topic], **span), most)
            if message is not None
        ]
        for span in spans
    ]
    check = check_odometry(windows)
    one = Candidate(topic, counted(n, "message"), check=check)
    if not check.use:
        return one._replace(penalty=9, against=check.why, usable=False, readable=False)
    using = "motion from its poses: " if check.use == "poses" else ""
    why = f"{using}{check.why}"
    if not check.moves:
        return one._replace(penalty=4, against="does not move")
    if _TRUTH.search(topic):
        return one._replace(
            penalty=3, against="; ".join(filter(None, ("ground truth by its name", why)))
        )
    return one._replace(penalty=1 if check.use == "poses" else 0, against=why)


def _scan(reader: Any, topic: str, n: int) -> Candidate:  # noqa: ANN401
    some = _examples(reader, topic, n, _EXAMINED)
    beams = max((len(message.ranges) for message in some), default=0)
    one = Candidate(topic, f"{counted(beams, 'beam')}, {counted(n, 'message')}")
    if not beams:
        return one._replace(penalty=9, against="no beams", usable=False, readable=False)
    hits = any(
        np.any((r >= message.range_min) & (r <= message.range_max))
        for message in some
        for r in (np.asarray(message.ranges),)
    )
    return one if hits else one._replace(penalty=4, against="nothing in range")
