"""A drive in memory: small grey pictures, and the key frames that tuning compares."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from neuroslam.config.sections import Region
from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors import Source
from neuroslam.sensors.grey import to_grey
from neuroslam.types import Frame, GreyRule
from neuroslam.view.features import Encoder
from neuroslam.view.preprocess import Encoded
from neuroslam.view.templates import to_bytes

MAX_FRAMES = 12_000
"""Frames that tuning uses, at most; the rest of a longer drive is ignored."""

_WIDTH_PX = 160
_MAX_KEYS = 1500
_MIN_FRAMES = 100


@dataclass(frozen=True)
class Drive:
    """The frames of a source that have a picture.

    Attributes:
        frames: Frames with pictures reduced in size, grey.
        factor: Width of a reduced pixel in pixels of the source.
        size: Width and height of the source's pictures, px.
        unusable: Number of frames that were left out.
        views: Templates that a network made from the source's pictures, by frame index, rounded
            to bytes; ``None`` for grey templates.
    """

    frames: list[Frame]
    factor: int
    size: tuple[int, int]
    unusable: int
    views: dict[int, Encoded] | None = None

    @property
    def pictures(self) -> np.ndarray:
        """All reduced pictures, ``uint8``, ``(n, h, w)``."""
        return np.stack([frame.image for frame in self.frames if frame.image is not None])

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a reduced picture."""
        return self.size[1] // self.factor, self.size[0] // self.factor

    def templates(self, keys: np.ndarray) -> np.ndarray:
        """Return the network's templates of some frames, in [0, 1], ``(n, height, width)``.

        Args:
            keys: Positions of the frames in ``frames``.

        Raises:
            ValueError: If the drive was read without a network.
        """
        if self.views is None:
            raise ValueError("Drive.templates: the drive was read without an encoder; give one")
        views = self.views
        return np.stack([views[self.frames[key].index].template for key in keys]) / 255.0

    @property
    def frame_rate_hz(self) -> float:
        """Mean frame rate."""
        return (len(self.frames) - 1) / (self.frames[-1].time_s - self.frames[0].time_s)

    @property
    def has_motion(self) -> bool:
        """Whether the source itself measures motion."""
        return self.frames[-1].velocity is not None

    def region(self, left: float, right: float, top: float, bottom: float) -> Region:
        """Return a region of the reduced pictures from fractions of their width and height."""
        height, width = self.shape
        return (round(left * width), round(right * width), round(top * height),
                round(bottom * height))  # fmt: skip

    def to_source(self, region: Region | None) -> Region | None:
        """Convert a region of the reduced pictures to pixels of the source."""
        if region is None:
            return None
        x_min, x_max, y_min, y_max = (edge * self.factor for edge in region)
        return x_min, x_max, y_min, y_max

    def to_reduced(self, region: Region | None) -> Region | None:
        """Convert a region of the source's pictures to pixels of the reduced ones."""
        if region is None:
            return None
        x_min, x_max, y_min, y_max = (edge // self.factor for edge in region)
        return x_min, x_max, y_min, y_max


def read_drive(
    source: Source,
    stop: int | None = None,
    encoder: Encoder | None = None,
    grey: GreyRule = "luma",
) -> Drive:
    """Read a source once and reduce its pictures; unusable frames are left out.

    Args:
        source: A recording, not a live source.
        stop: Frame to stop before.
        encoder: Makes the templates, each once; ``None`` for those of grey levels.
        grey: How colour becomes grey.

    Raises:
        SourceError: If fewer than a hundred frames have a picture.
    """
    frames: list[Frame] = []
    faults: list[BadFrame] = []
    views: dict[int, Encoded] = {}
    factor, size = 1, (0, 0)
    for frame in source.frames(stop=stop, on_bad_frame=faults.append):
        if frame.image is None:
            continue
        if not frames:
            size = (frame.image.shape[1], frame.image.shape[0])
            factor = max(1, size[0] // _WIDTH_PX)
        if (frame.image.shape[1], frame.image.shape[0]) != size:
            continue
        if encoder is not None:
            try:
                view = encoder(frame.image)
            except BadFrame as fault:
                faults.append(fault)
                continue
            views[frame.index] = view._replace(template=to_bytes(view.template))
        frames.append(frame._replace(image=_reduced(to_grey(frame.image, grey), factor)))
        if len(frames) == MAX_FRAMES:
            break
    if len(frames) < _MIN_FRAMES:
        raise SourceError(
            f"{source.name}: {counted(len(frames), 'frame')} with a picture; tuning needs "
            f"{_MIN_FRAMES} or more, of a drive that revisits places"
        )
    return Drive(frames, factor, size, len(faults), None if encoder is None else views)


def _reduced(grey: np.ndarray, factor: int) -> np.ndarray:
    height, width = grey.shape[0] // factor, grey.shape[1] // factor
    if factor == 1:
        return grey
    part = grey[: height * factor, : width * factor]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)


def key_frames(drive: Drive) -> np.ndarray:
    """Choose key frames evenly among the frames whose picture differs from the one before.

    Frames of a robot at rest hold no information about its motion.

    Returns:
        Their positions in the drive, rising; at most 1500.

    Raises:
        SourceError: If too few pictures change.
    """
    pictures = drive.pictures
    change = np.array([cv2.absdiff(before, now).mean() for before, now in pairwise(pictures)])
    moving = 1 + np.flatnonzero(change > 0.2 * np.median(change))
    if len(moving) < _MIN_FRAMES // 2:
        raise SourceError(
            f"only {len(moving)} of {len(pictures)} pictures differ from the one before, expected "
            f"{_MIN_FRAMES // 2} or more; tune on a recording of a moving robot"
        )
    return moving[:: -(-len(moving) // _MAX_KEYS)]
