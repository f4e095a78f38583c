"""Renders a world for a camera: one ray per column, in operations on whole arrays."""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from neuroslam.geometry import TWO_PI, rotation_matrix
from neuroslam.types import Pose
from neuroslam.worlds.atlas import LEVELS_GROUND, LEVELS_U, LEVELS_V, Atlas
from neuroslam.worlds.camera import FINE, Camera, Hits
from neuroslam.worlds.ramps import draw_inclined, in_view, larger_camera, warp
from neuroslam.worlds.scene import Billboard, Surface, World

_NO_HIT = 1e6  # depth (m) of a ray that hits nothing
_NEAR_M = 0.15  # nearer figures are not drawn


def render(
    world: World,
    pose: Pose,
    camera: Camera,
    figures: Sequence[Billboard] = (),
    gain: float = 1.0,
    pitch_rad: float | None = None,
) -> np.ndarray:
    """Render the image of a camera.

    Args:
        world: The world.
        pose: Pose of the camera: metres, metres, radians.
        camera: The camera.
        figures: Figures in addition to those of the world, such as pedestrians.
        gain: Factor on all grey levels, clipped at white.
        pitch_rad: Pitch of a pinhole camera upwards, in a world whose ramps are drawn; ``None``:
            it is level, and so are the ramps.

    Returns:
        ``uint8 (height, width, 3)``, RGB.
    """
    shown, pitch = camera, pitch_rad or 0.0
    camera, ramps = larger_camera(camera, pitch), () if pitch_rad is None else world.ramps
    rays = camera.rays @ rotation_matrix(pose.theta_rad).T
    layers = cast(world, pose, rays, camera.camera_height_m)
    length = np.hypot(rays[:, 0], rays[:, 1]).astype(np.float32)
    shape = (len(camera.slopes), camera.width)
    columns, rows, clear = (np.empty(shape, dtype=np.float32) for _ in range(3))
    if not pitch_rad and not in_view(ramps, pose, rays, layers[-1].depth):
        _draw_level(world, pose, rays, camera, layers, length, (columns, rows, clear))
    else:
        draw_inclined(world, pose, rays, camera, layers[-1], length, columns, rows, clear)
    np.exp(clear * np.float32(-1.0 / world.sight_m), out=clear)

    image = cv2.remap(world.atlas.image, columns, rows, cv2.INTER_LINEAR)
    haze = np.empty_like(image)
    haze[:] = world.haze
    image = cv2.blendLinear(image, haze, clear, 1.0 - clear)
    _draw_figures(image, world, pose, rays, camera, figures, layers)
    image = warp(image, camera, shown, pitch)
    image = cv2.resize(image, (shown.width, shown.height), interpolation=cv2.INTER_AREA)
    return image if gain == 1.0 else cv2.convertScaleAbs(image, alpha=gain)


def _draw_level(
    world: World,
    pose: Pose,
    rays: np.ndarray,
    camera: Camera,
    layers: list[Hits],
    length: np.ndarray,
    buffers: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write, for every pixel, its position in the atlas and its distance: floors are level."""
    columns, rows, clear = buffers
    slopes = camera.slopes[:, None]
    sky_rows = int(np.count_nonzero(slopes > 0.0))
    _draw_flat(world, world.ground, pose, rays, camera, slice(sky_rows, None), columns, rows)
    clear[sky_rows:] = -camera.camera_height_m / slopes[sky_rows:] * length
    if world.ceiling is not None:
        _draw_flat(world, world.ceiling, pose, rays, camera, slice(0, sky_rows), columns, rows)
        rise = world.ceiling.height_m - camera.camera_height_m
        clear[:sky_rows] = rise / slopes[:sky_rows] * length
    else:
        _draw_sky(world.atlas, rays, slopes[:sky_rows], length, columns, rows)
        clear[:sky_rows] = 0.0
    for hits in layers:
        _draw_upright(world.atlas, hits, camera, length, columns, rows, clear)


def cast(world: World, pose: Pose, rays: np.ndarray, eye_m: float) -> list[Hits]:
    r"""Find the surfaces that rays hit: the nearest wall or pillar, and the visibly highest one.

    A ray :math:`p + t d` hits the wall :math:`a + q e`, with :math:`a` relative to :math:`p`, at
    :math:`t = (a \times e) / (d \times e)` and :math:`q = (a \times d) / (d \times e)`.

    Args:
        world: The world.
        pose: Origin of the rays; its heading is not used.
        rays: Directions in the world's axes, shape ``(n, 2)``.
        eye_m: Height of the rays above the floor.

    Returns:
        The nearest hits, as the last item. If the surfaces differ in height, an item before it has
        the hits of highest elevation, which may be visible above the nearest.
    """
    at = np.array([pose.x_m, pose.y_m])
    start = world.walls[:, :2] - at
    edge = world.walls[:, 2:] - world.walls[:, :2]
    across = start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]
    visible = across < 0.0  # the others are seen from behind
    middle = rays[len(rays) // 2]
    if np.all(rays @ middle > 0.0):  # all rays point forwards: walls behind are not visible
        ahead = np.maximum(start @ middle, (start + edge) @ middle)
        visible &= ahead > 0.0
    index = np.flatnonzero(visible) if visible.any() else np.zeros(1, dtype=int)
    start, edge, across = start[index], edge[index], across[index]
    x, y = rays[:, :1], rays[:, 1:]
    below = np.minimum(x * edge[:, 1] - y * edge[:, 0], -1e-12)
    share = start[:, 0] * y - start[:, 1] * x
    hits = (share <= 1e-9) & (share >= below - 1e-9) & (across < 0.0)
    depth = np.where(hits, across / below, _NO_HIT)
    strip = world.wall_strips[index]
    root = np.empty((len(rays), 0))
    if len(world.pillars):
        toward = rays @ (world.pillars[:, :2] - at).T
        off = x * (world.pillars[:, 1] - at[1]) - y * (world.pillars[:, 0] - at[0])
        square = x * x + y * y
        inside = square * world.pillars[:, 2] ** 2 - off * off
        root = np.sqrt(np.maximum(inside, 0.0))
        reach = (toward - root) / square
        reach = np.where((inside > 0.0) & (reach > 0.0), reach, _NO_HIT)
        depth = np.hstack([depth, reach])
        strip = np.concatenate([strip, world.pillar_strips])

    column = np.arange(len(rays))
    lengths = np.hypot(edge[:, 0], edge[:, 1])
    top = world.strip_heights_m[strip]

    def describe(which: np.ndarray) -> Hits:
        t = depth[column, which]
        wall = np.minimum(which, len(index) - 1)
        along = share[column, wall] / below[column, wall] * lengths[wall]
        along += world.wall_offsets_m[index[wall]]
        slant = -below[column, wall] / lengths[wall]
        if len(world.pillars):
            pillar = which - len(index)
            is_pillar = pillar >= 0
            p = world.pillars[np.maximum(pillar, 0)]
            hit = at + t[:, None] * rays - p[:, :2]
            angle = np.arctan2(hit[:, 1], hit[:, 0]) + math.pi
            along = np.where(is_pillar, angle * p[:, 2], along)
            slant = np.where(is_pillar, root[column, np.maximum(pillar, 0)] / p[:, 2], slant)
        return Hits(
            t, strip[which], along, np.maximum(slant, 1e-3), np.where(t < _NO_HIT, top[which], 0.0)
        )

    near = describe(np.argmin(depth, axis=1))
    if np.ptp(world.strip_heights_m) == 0.0:
        return [near]
    return [describe(np.argmax((top - eye_m) / depth, axis=1)), near]


def measure_ranges(world: World, pose: Pose, n_beams: int, eye_m: float) -> np.ndarray:
    """Return the ranges of a laser scanner: distances to walls and pillars, without noise.

    Args:
        world: The world.
        pose: Pose of the scanner.
        n_beams: Number of beams, evenly over the full turn, counter-clockwise from ahead.
        eye_m: Height of the scanner above the floor.

    Returns:
        Metres, ``(n_beams,)``; ``inf`` where a beam hits nothing.
    """
    angle = pose.theta_rad + TWO_PI * np.arange(n_beams) / n_beams
    rays = np.column_stack([np.cos(angle), np.sin(angle)])
    depth = cast(world, pose, rays, eye_m)[-1].depth
    return np.where(depth < _NO_HIT, depth, np.inf)


def _draw_upright(
    atlas: Atlas,
    hits: Hits,
    camera: Camera,
    length: np.ndarray,
    columns: np.ndarray,
    rows: np.ndarray,
    clear: np.ndarray,
) -> None:
    """Write, for every pixel of these walls, its position in the atlas and its distance."""
    per_m = atlas.strip_per_m[hits.strip]
    per_column = per_m * hits.depth / (camera.focal_px * hits.slant)
    per_row = per_m * hits.depth / (FINE * camera.focal_px)
    u = np.clip(np.log2(per_column) + 0.5, 0, LEVELS_U - 1).astype(int)
    v = np.clip(np.log2(per_row) + 0.5, 0, LEVELS_V - 1).astype(int)
    origin = atlas.strip_origin[hits.strip, u, v]
    scale = atlas.strip_scale[hits.strip, u, v]
    depth = hits.depth.astype(np.float32)
    rise = (hits.top_m - camera.camera_height_m).astype(np.float32)

    slopes = camera.slopes[:, None]
    wall = (slopes <= rise / depth) & (slopes >= np.float32(-camera.camera_height_m) / depth)
    column = origin[:, 0] + hits.along_m.astype(np.float32) * scale[:, 0] - np.float32(0.5)
    row = (origin[:, 1] - np.float32(0.5) + rise * scale[:, 1]) - slopes * (depth * scale[:, 1])
    np.copyto(columns, column, where=wall)
    np.copyto(rows, row, where=wall)
    np.copyto(clear, depth * length, where=wall)


def _draw_flat(
    world: World,
    surface: Surface,
    pose: Pose,
    rays: np.ndarray,
    camera: Camera,
    part: slice,
    columns: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Write, for the rows of ``part``, the position of their floor or ceiling in the atlas."""
    ceiling = world.atlas.ceiling
    tiles = world.atlas.ground if ceiling is None or surface is world.ground else ceiling
    slopes = camera.slopes[part].astype(float)
    rise = surface.height_m - camera.camera_height_m
    depth = rise / slopes
    # A pixel's footprint: depth / f across, depth^2 / (rise f) along; their geometric mean.
    footprint = depth / camera.focal_px * np.sqrt(np.abs(depth / rise) / FINE)
    level = np.clip(np.log2(footprint * surface.px_per_m), 0, LEVELS_GROUND - 1).astype(int)
    left, top, scale_x, scale_y = tiles[level].T.astype(float)
    scale_x, scale_y = scale_x * surface.px_per_m, scale_y * surface.px_per_m
    y_top = surface.y_m + surface.image.shape[0] / surface.px_per_m
    start = left - 0.5 + (pose.x_m - surface.x_m) * scale_x
    columns[part] = np.multiply.outer(depth * scale_x, rays[:, 0]) + start[:, None]
    start = top - 0.5 + (y_top - pose.y_m) * scale_y
    rows[part] = start[:, None] - np.multiply.outer(depth * scale_y, rays[:, 1])


def _draw_sky(
    atlas: Atlas,
    rays: np.ndarray,
    slopes: np.ndarray,
    length: np.ndarray,
    columns: np.ndarray,
    rows: np.ndarray,
) -> None:
    """Write, for the rows above the horizon, the position of their sky in the atlas."""
    if atlas.sky is None:
        return
    left, top, width, height = atlas.sky
    turn = (math.pi - np.arctan2(rays[:, 1], rays[:, 0])) / TWO_PI
    columns[: len(slopes)] = left - 0.5 + turn * width
    up = np.minimum(slopes / length, 1.0)
    rows[: len(slopes)] = (top + height - 1.0) - up * (height - 1.0)


def _draw_figures(
    image: np.ndarray,
    world: World,
    pose: Pose,
    rays: np.ndarray,
    camera: Camera,
    figures: Sequence[Billboard],
    layers: list[Hits],
) -> None:
    """Blend figures into the rendered rows, farthest first, where no wall hides them."""
    every = [*world.billboards, *figures]
    if not every:
        return
    table = np.array(every)
    dx, dy = table[:, 0] - pose.x_m, table[:, 1] - pose.y_m
    distance = np.maximum(np.hypot(dx, dy), 1e-9)
    dx, dy = dx / distance, dy / distance
    # A figure faces the camera: its plane is perpendicular to the line of sight to its middle.
    toward = rays[:, :1] * dx + rays[:, 1:] * dy
    depth = distance / np.maximum(toward, 0.05)
    aside = depth * (rays[:, :1] * dy - rays[:, 1:] * dx)
    shown = (toward > 0.05) & (np.abs(aside) < 0.5 * table[:, 2])
    shown &= (distance > _NEAR_M) & (distance < table[:, 3] * camera.focal_px)
    top = (table[:, 3] - camera.camera_height_m) / depth
    for hits in layers:
        rise = (hits.top_m - camera.camera_height_m) / hits.depth
        shown &= (depth < hits.depth[:, None]) | (top > rise[:, None])
    for i in np.argsort(-distance, kind="stable").tolist():
        columns = np.flatnonzero(shown[:, i])
        if len(columns):
            ahead, across = depth[columns, i], aside[columns, i]
            far = float(distance[i])
            _blend(image, world, camera, every[i], far, columns, ahead, across, layers)


def _blend(
    image: np.ndarray,
    world: World,
    camera: Camera,
    figure: Billboard,
    distance: float,
    columns: np.ndarray,
    depth: np.ndarray,
    aside: np.ndarray,
    layers: list[Hits],
) -> None:
    """Blend one figure into some columns of the rendered rows."""
    eye = camera.camera_height_m
    downward = -camera.slopes
    nearest = depth.min()
    first = int(np.searchsorted(downward, (eye - figure.height_m) / nearest))
    last = int(np.searchsorted(downward, eye / nearest, side="right"))
    slope = camera.slopes[first:last, None]

    levels = world.figure_levels[figure.cutout]
    per_row = levels[0].shape[0] / figure.height_m * distance / (FINE * camera.focal_px)
    texture = levels[min(max(int(math.log2(per_row) + 0.3), 0), len(levels) - 1)]
    h, w = texture.shape[:2]
    v = (figure.height_m - eye - slope * depth) * (h / figure.height_m) - 0.5
    v = v.astype(np.float32)
    u = np.empty_like(v)
    u[:] = (aside / figure.width_m + 0.5) * w - 0.5
    patch = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    patch = patch.astype(np.float32)
    for hits in layers:
        wall = hits.depth[columns]
        patch[(depth > wall) & (slope <= (hits.top_m[columns] - eye) / wall)] = 0.0

    fade = math.exp(-distance / world.sight_m)
    tint = np.zeros((3, 4))  # colours are premultiplied by opacity, the fourth channel
    tint[:, :3] = np.eye(3) * fade
    tint[:, 3] = np.array(world.haze) * ((1.0 - fade) / 255.0)
    veil = np.zeros((3, 5))
    veil[:, 3:] = -1.0 / 255.0, 1.0
    under = image[first:last, columns] * cv2.transform(patch, veil)
    under += cv2.transform(patch, tint)
    image[first:last, columns] = (under + 0.5).astype(np.uint8)
