"""A drive in memory: small grey pictures, and which of them stand for the whole."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from neuroslam.config.sections import Region
from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors import Source
from neuroslam.types import Frame
from neuroslam.view.features import FeatureEncoder
from neuroslam.view.preprocess import Encoded
from neuroslam.view.templates import to_bytes

MAX_FRAMES = 12_000
"""A longer drive is tuned on its first so many frames."""

_WIDTH_PX = 160
_MAX_KEYS = 1500
_MIN_FRAMES = 100


@dataclass(frozen=True)
class Drive:
    """The frames of a source that have a picture.

    Attributes:
        frames: With pictures made smaller, grey.
        factor: How many pixels of the source a pixel has, each way.
        size: Width and height of the source's pictures, px.
        unusable: Frames that were left out.
        views: Templates that a network made of the source's own pictures, by the frames' indices,
            rounded to bytes; ``None``: templates are of grey.
    """

    frames: list[Frame]
    factor: int
    size: tuple[int, int]
    unusable: int
    views: dict[int, Encoded] | None = None

    @property
    def pictures(self) -> np.ndarray:
        """All pictures, ``uint8``, ``(n, h, w)``."""
        return np.stack([frame.image for frame in self.frames])

    def templates(self, keys: np.ndarray) -> np.ndarray:
        """Return what the network made of some frames, in [0, 1], ``(n, height, width)``."""
        return np.stack([self.views[self.frames[key].index].template for key in keys]) / 255.0

    @property
    def frame_rate_hz(self) -> float:
        """Frames per second, on average."""
        return (len(self.frames) - 1) / (self.frames[-1].time_s - self.frames[0].time_s)

    @property
    def has_motion(self) -> bool:
        """Whether the source itself measures motion."""
        return self.frames[-1].velocity is not None

    def region(self, left: float, right: float, top: float, bottom: float) -> Region:
        """Return a part of the small pictures, given as shares of their width and height."""
        height, width = self.frames[0].image.shape
        return (round(left * width), round(right * width), round(top * height),
                round(bottom * height))  # fmt: skip

    def in_source(self, region: Region | None) -> Region | None:
        """Return a region of the small pictures in pixels of the source."""
        return None if region is None else tuple(edge * self.factor for edge in region)

    def here(self, region: Region | None) -> Region | None:
        """Return a region of the source's pictures in pixels of the small ones."""
        return None if region is None else tuple(edge // self.factor for edge in region)


def read_drive(
    source: Source, stop: int | None = None, encoder: FeatureEncoder | None = None
) -> Drive:
    """Read a source once and keep its pictures small; frames that cannot be used are left out.

    Args:
        source: Not a live one.
        stop: Frame to stop before.
        encoder: Makes the templates, where they are not of grey.

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
        frames.append(frame._replace(image=_smaller(frame.image, factor)))
        if len(frames) == MAX_FRAMES:
            break
    if len(frames) < _MIN_FRAMES:
        raise SourceError(
            f"{source.name}: {counted(len(frames), 'frame')} with a picture; tuning needs "
            f"{_MIN_FRAMES} or more, of a drive that comes back to where it was"
        )
    return Drive(frames, factor, size, len(faults), None if encoder is None else views)


def _smaller(image: np.ndarray, factor: int) -> np.ndarray:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    height, width = grey.shape[0] // factor, grey.shape[1] // factor
    if factor == 1:
        return grey
    part = grey[: height * factor, : width * factor]
    return cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)


def key_frames(drive: Drive) -> np.ndarray:
    """Choose frames, evenly, among those where the picture changes: standing still tells nothing.

    Returns:
        Their numbers in the drive, rising; at most 1500.

    Raises:
        SourceError: If the picture hardly ever changes.
    """
    pictures = drive.pictures
    change = np.array([cv2.absdiff(before, now).mean() for before, now in pairwise(pictures)])
    moving = 1 + np.flatnonzero(change > 0.2 * np.median(change))
    if len(moving) < _MIN_FRAMES // 2:
        raise SourceError(
            f"only {len(moving)} of {len(pictures)} pictures differ from the one before; tuning "
            "needs a drive"
        )
    return moving[:: -(-len(moving) // _MAX_KEYS)]
