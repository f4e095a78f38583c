"""The camera of a rendered world, and what its columns hit."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from neuroslam.geometry import TWO_PI

FINE = 2
"""Rows rendered per row of the image, so that slanted edges are smooth."""


@dataclass(frozen=True)
class Camera:
    """A level camera whose middle column looks ahead; the left half of the image shows the left.

    A point at ``depth`` along a column's ray and ``z`` above the camera is ``focal_px * z / depth``
    pixels above the horizon. Pinhole: depth is measured along the axis, columns are equally wide on
    a plane. Panoramic: depth is the distance, columns are equal angles of the full turn.

    Attributes:
        width: Number of columns.
        height: Number of rows.
        fov_deg: Horizontal field of view; ignored if panoramic.
        panoramic: Whether the image is a cylindrical panorama of the full turn.
        camera_height_m: Height above the floor.
        horizon: Row of the horizon as a fraction of the height, from the top.

    Example:
        >>> Camera(width=160, height=60, fov_deg=90.0).focal_px
        80.0
    """

    width: int = 160
    height: int = 64
    fov_deg: float = 90.0
    panoramic: bool = False
    camera_height_m: float = 1.1
    horizon: float = 0.5

    @cached_property
    def focal_px(self) -> float:
        """Focal length in pixels: pixels per unit of slope."""
        if self.panoramic:
            return self.width / TWO_PI
        return round(0.5 * self.width / math.tan(math.radians(self.fov_deg) / 2.0), 9)

    @cached_property
    def rays(self) -> np.ndarray:
        """Ray of each column at depth 1, ``(width, 2)``, in the robot's axes: x forward, y left."""
        right = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal_px
        if self.panoramic:
            return np.column_stack([np.cos(right), -np.sin(right)])
        return np.column_stack([np.ones(self.width), -right])

    @cached_property
    def slopes(self) -> np.ndarray:
        """Slope of each rendered row, positive upwards, ``float32 (FINE * height,)``."""
        rows = (np.arange(FINE * self.height) + 0.5) / FINE
        return ((self.horizon * self.height - rows) / self.focal_px).astype(np.float32)


class Hits(NamedTuple):
    """The surface that the ray of each column hits; all arrays have shape ``(width,)``.

    Attributes:
        depth: Depth of the hit in units of the ray.
        strip: Texture of the surface.
        along_m: Position on the texture.
        slant: Sine of the angle between ray and surface, times the length of the ray.
        top_m: Height of the surface.
    """

    depth: np.ndarray
    strip: np.ndarray
    along_m: np.ndarray
    slant: np.ndarray
    top_m: np.ndarray
