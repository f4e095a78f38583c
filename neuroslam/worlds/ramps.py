r"""Ramps of a building, drawn as inclined floors between level ones, and seen by a pitched camera.

A pixel of slope :math:`s` in a column of direction :math:`(r_x, r_y)` meets the floor
:math:`z = a + b x` at the depth

.. math:: d = \frac{a + b\,x_0 - e}{s - b\,r_x}

with the eye :math:`e` above the storey, and shows the nearest of floors, ceilings and walls. Walls
stand upright on all storeys, whose height is their texture's period. A pitch :math:`p` upwards
rotates the ray :math:`(1, r, s)` to :math:`(\cos p - s \sin p,\; r,\; \sin p + s \cos p)`, so the
image is that of a level camera, warped.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.types import Pose
from neuroslam.worlds.atlas import LEVELS_GROUND, LEVELS_U, LEVELS_V
from neuroslam.worlds.camera import FINE, Camera, Hits
from neuroslam.worlds.scene import Ramp, World

_MARGIN = 1.25, 1.7  # width and height of the image that is warped, as shares of the camera's
_FAR_M = 1e6
_INSIDE_M = 0.05


class Floor(NamedTuple):
    """A part of a floor: the plane ``a_m + slope * x`` over a rectangle of the plan."""

    a_m: float
    slope: float
    x0_m: float
    x1_m: float
    y0_m: float
    y1_m: float


def floors_around(ramps: tuple[Ramp, ...], x_m: float, y_m: float) -> tuple[list[Floor], float]:
    """Return the inclined and other floors that a robot may see, and its height above its storey.

    From the storey a ramp is seen from its nearer end; the storey itself is at 0. From a ramp the
    storey of its begin is at 0, and that of its end is among the floors.

    Example:
        >>> up = Ramp(-5.0, 5.0, 1.0, 3.0, 2.0)
        >>> floors_around((up,), 0.0, 2.0)[1]
        1.0
        >>> floors_around((up,), 7.0, 0.0)[0][0].a_m  # it ends here, and began a storey below
        -1.0
    """
    found = []
    for ramp in ramps:
        slope = ramp.rise_m / (ramp.x1_m - ramp.x0_m)
        bounds = ramp.x0_m, ramp.x1_m, ramp.y0_m - _INSIDE_M, ramp.y1_m + _INSIDE_M
        plane = Floor(-slope * ramp.x0_m, slope, *bounds)
        if ramp.covers(x_m, y_m):
            above = Floor(ramp.rise_m, 0.0, ramp.x1_m, _FAR_M, -_FAR_M, _FAR_M)
            return [plane, above], ramp.height(x_m)
        if x_m > 0.5 * (ramp.x0_m + ramp.x1_m):
            plane = plane._replace(a_m=plane.a_m - ramp.rise_m)
        found.append(plane)
    return found, 0.0


def in_view(ramps: tuple[Ramp, ...], pose: Pose, rays: np.ndarray, depth: np.ndarray) -> bool:
    """Return whether a column shows a ramp before the wall at which it ends.

    Args:
        ramps: Of the world.
        pose: Of the camera.
        rays: Of its columns, ``(n, 2)``.
        depth: Of the nearest wall in each, ``(n,)``.
    """
    for ramp in ramps:
        enters, leaves = np.zeros(len(rays)), depth
        for at, ray, low, high in (
            (pose.x_m, rays[:, 0], ramp.x0_m, ramp.x1_m),
            (pose.y_m, rays[:, 1], ramp.y0_m, ramp.y1_m),
        ):
            step = np.where(np.abs(ray) < 1e-12, 1e-12, ray)
            ends = (low - at) / step, (high - at) / step
            enters = np.maximum(enters, np.minimum(*ends))
            leaves = np.minimum(leaves, np.maximum(*ends))
        if (enters < leaves).any():
            return True
    return False


def larger_camera(camera: Camera, pitch_rad: float) -> Camera:
    """Return a level camera whose image has all that a pitched one shows."""
    if not pitch_rad:
        return camera
    width, height = (math.ceil(n * m / 2) * 2 for n, m in zip(
        (camera.width, camera.height), _MARGIN, strict=True))  # fmt: skip
    fov = math.degrees(2.0 * math.atan(0.5 * width / camera.focal_px))
    rows = camera.horizon * camera.height + 0.5 * (height - camera.height)
    return replace(camera, width=width, height=height, fov_deg=fov, horizon=rows / height)


def warp(level: np.ndarray, of: Camera, camera: Camera, pitch_rad: float) -> np.ndarray:
    """Warp the fine rows of a level camera's image to those of a pitched one.

    Args:
        level: Image of :func:`larger_camera`.
        of: That camera.
        camera: The one that is pitched.
        pitch_rad: Upwards.
    """
    if not pitch_rad:
        return level
    slopes = camera.slopes[:, None].astype(float)
    right = (np.arange(camera.width) + 0.5 - 0.5 * camera.width) / camera.focal_px
    ahead = math.cos(pitch_rad) - slopes * math.sin(pitch_rad)
    up = (math.sin(pitch_rad) + slopes * math.cos(pitch_rad)) / ahead
    columns = right / ahead * of.focal_px + 0.5 * of.width - 0.5
    rows = (of.horizon * of.height - up * of.focal_px) * FINE - 0.5
    rows = np.broadcast_to(rows, columns.shape)
    return cv2.remap(
        level, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip


def draw_inclined(
    world: World,
    pose: Pose,
    rays: np.ndarray,
    camera: Camera,
    near: Hits,
    length: np.ndarray,
    columns: np.ndarray,
    rows: np.ndarray,
    clear: np.ndarray,
) -> None:
    """Write, for every pixel, its position in the atlas and its distance.

    Args:
        world: With ramps, and a ceiling.
        pose: Of the camera.
        rays: Of its columns, in the world's axes.
        camera: Its ``camera_height_m`` is above the floor below it.
        near: Nearest wall in each column.
        length: Of each ray.
        columns: Written.
        rows: Written.
        clear: Written: the distance.
    """
    assert world.ceiling is not None
    inclined, raised = floors_around(world.ramps, pose.x_m, pose.y_m)
    eye = camera.camera_height_m + raised
    slopes = camera.slopes[:, None].astype(float)
    depth = np.repeat(near.depth[None, :], len(slopes), axis=0)
    _draw_walls(world, near, camera, slopes, eye, columns, rows)
    atlas, tall = world.atlas, world.ceiling.height_m
    surfaces = ((atlas.ground, world.ground, 0.0), (atlas.ceiling, world.ceiling, tall))
    for tiles, surface, above in surfaces:
        assert tiles is not None
        nearest = _meets(inclined, pose, rays, slopes, eye - above)
        shown = nearest < depth
        depth[shown] = nearest[shown]
        d, row, column = nearest[shown], *np.nonzero(shown)
        drop = np.maximum(np.abs(slopes[row, 0]) * d, 0.2)
        footprint = d / camera.focal_px * np.sqrt(d / drop / FINE)
        level = np.clip(np.log2(footprint * surface.px_per_m), 0, LEVELS_GROUND - 1).astype(int)
        left, top, scale_x, scale_y = tiles[level].T.astype(float)
        y_top = surface.y_m + surface.image.shape[0] / surface.px_per_m
        x, y = pose.x_m + d * rays[column, 0], pose.y_m + d * rays[column, 1]
        columns[shown] = left - 0.5 + (x - surface.x_m) * scale_x * surface.px_per_m
        rows[shown] = top - 0.5 + (y_top - y) * scale_y * surface.px_per_m
    clear[:] = depth * length


def _meets(
    inclined: list[Floor], pose: Pose, rays: np.ndarray, slopes: np.ndarray, eye: float
) -> np.ndarray:
    """Return the depth at which each pixel meets the nearest part of a floor, else far away."""
    nearest = np.full((len(slopes), len(rays)), _FAR_M)
    whole = Floor(0.0, 0.0, -_FAR_M, _FAR_M, -_FAR_M, _FAR_M)
    for part in (*inclined, whole):
        with np.errstate(divide="ignore", invalid="ignore"):
            d = (part.a_m + part.slope * pose.x_m - eye) / (slopes - part.slope * rays[:, 0])
        x, y = pose.x_m + d * rays[:, 0], pose.y_m + d * rays[:, 1]
        holds = (d > 0.0) & (d < nearest)
        if part is whole:
            for other in inclined:
                holds &= ~_within(other, x, y)
        else:
            holds &= _within(part, x, y)
        nearest[holds] = d[holds]
    return nearest


def _within(part: Floor, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    inside = (x >= part.x0_m) & (x <= part.x1_m) & (y >= part.y0_m) & (y <= part.y1_m)
    return np.asarray(inside)


def _draw_walls(
    world: World,
    hits: Hits,
    camera: Camera,
    slopes: np.ndarray,
    eye: float,
    columns: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Write the position of the nearest wall, upright on every storey, in all rows."""
    atlas = world.atlas
    per_m = atlas.strip_per_m[hits.strip]
    per_column = per_m * hits.depth / (camera.focal_px * hits.slant)
    per_row = per_m * hits.depth / (FINE * camera.focal_px)
    u = np.clip(np.log2(per_column) + 0.5, 0, LEVELS_U - 1).astype(int)
    v = np.clip(np.log2(per_row) + 0.5, 0, LEVELS_V - 1).astype(int)
    origin = atlas.strip_origin[hits.strip, u, v].astype(float)
    scale = atlas.strip_scale[hits.strip, u, v].astype(float)
    height = (eye + slopes * hits.depth) % world.storey_m  # above the floor of its storey
    down = np.clip(hits.top_m - height, 0.0, hits.top_m)
    columns[:] = origin[:, 0] + hits.along_m * scale[:, 0] - 0.5
    rows[:] = origin[:, 1] - 0.5 + down * scale[:, 1]
