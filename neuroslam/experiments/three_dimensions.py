"""Storeys that look alike: pose cells in x, y, z and heading beside those of the plane.

Settings are those of the preset ``neuroslam_3d``, chosen on look 0 of the garage and of the atrium;
the drives here are through other looks, with other noise.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from neuroslam.brain import NavigationBrain
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.cells.pose_3d import Pose3DConfig, PoseCells3D
from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.evaluation.storeys import error_in_3d, on_another_storey
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.style import LOOP, MAP, ODOMETRY, STYLE, TRUTH, new_figure, save, write_title
from neuroslam.geometry import compose_poses, integrate_velocities
from neuroslam.mapping.tables import closes_loop
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Motion, Velocity
from neuroslam.worlds.storeys import STOREY_M
from neuroslam.worlds.world import WorldSource, open_world

METHODS: dict[str, dict[str, Any]] = {
    "given": {},
    "seen": {"odometry": {"method": "flow"}},
    "rows": {"odometry": {"method": "profiles"}},
    "plane": {"cells": ["pose"]},
}
"""How the height is measured -> differences from the preset ``neuroslam_3d``: the speed upwards of
the source, that of the images by corners and by the profile of their rows, and no height."""

CLIMBS = {"garage": "pitch", "atrium": "slope"}
"""What a camera shows of the height: a car's pitches on ramps, a drone's stays level."""

_DT_S = 0.2


class Drive(NamedTuple):
    """One drive as measured: the true track, odometry alone, and what a brain made of it.

    Attributes:
        truth: x, y, z of every frame, metres, ``(n, 3)``.
        odometry: The same by dead reckoning.
        track: The same on the final map.
        confused: Frames on another storey than believed, ``bool (n,)``.
        wrong_links: Links of the map between storeys.
        loops: Links that close a loop.
        frame_ms: Mean CPU time of the brain a frame.
    """

    truth: np.ndarray
    odometry: np.ndarray
    track: np.ndarray
    confused: np.ndarray
    wrong_links: int
    loops: int
    frame_ms: float


def three_dimensions(
    _data_folder: Path | None,
    out_folder: Path,
    drives: int = 100,
    flights: int = 12,
    looks: Sequence[int] = (1, 2),
    noise: float = 0.05,
    frames: int = 950,
) -> dict[str, Any]:
    """Drive through three storeys that look alike; count the drives that confuse them.

    Every drive is mapped with the height given, seen and ignored.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` and ``three_dimensions.png`` are written there.
        drives: Drives through the garage, shared among the looks; each has noise of its own.
        flights: The same of the atrium.
        looks: Seeds of the textures.
        noise: Level of the noise of odometry and of the speed upwards.
        frames: Of a drive, 5 a second.

    Returns:
        The content of ``results.json``: a row for each world and method.
    """
    found: dict[tuple[str, str], list[Drive]] = {}
    with limit_threads(1):
        for world, n in (("garage", drives), ("atrium", flights)):
            for i, look in enumerate(looks):
                seeds = range(100 * look, 100 * look + len(range(i, n, len(looks))))
                if not len(seeds):
                    continue
                spec = f"world:{world}?look={look}&grey=true&rate=5&frames_per_lap={frames}"
                images = _images(open_world(spec))
                for seed in seeds:
                    source = open_world(f"{spec}&noise={noise:g}&seed={seed}")
                    for method in methods_of(world):
                        one = _drive(method, world, source, images)
                        found.setdefault((world, method), []).append(one)
        cells_us = {name: _cells_us(name) for name in ("given", "plane")}
    rows = [_row(*key, each, cells_us.get(key[1])) for key, each in found.items()]
    results = {"rows": rows, "noise": noise, "looks": list(looks)}
    save(_plot(found), Path(out_folder) / "three_dimensions.png")
    write_results(Path(out_folder), results)
    return results


def _images(source: WorldSource) -> list[np.ndarray]:
    """Render a drive once: its images do not depend on the noise of odometry."""
    return [cast(np.ndarray, frame.image) for frame in source]


def _frames(source: WorldSource, images: Sequence[np.ndarray]) -> Iterator[Frame]:
    rows = zip(images, source.odometry().tolist(), source.climbs().tolist(), strict=True)
    for i, (image, velocity, climb) in enumerate(rows):
        yield Frame(i, i * _DT_S, image, Velocity(velocity[0], velocity[1]), v_z_m_s=climb)


def methods_of(world: str) -> list[str]:
    """Return the methods of a world: the profile of rows does not show a car's pitch."""
    return [name for name in METHODS if name != "rows" or CLIMBS[world] == "slope"]


def config_of(method: str, world: str = "garage") -> BrainConfig:
    """Return the config of a method of :data:`METHODS`."""
    values = merge_values(read_preset("neuroslam_3d"), METHODS[method])
    if method in ("seen", "rows"):
        values = merge_values(values, {"odometry": {"climb": CLIMBS[world]}})
    return build_config(values, method)


def _drive(method: str, world: str, source: WorldSource, images: Sequence[np.ndarray]) -> Drive:
    """Let a new brain take all frames of a drive."""
    brain = NavigationBrain(config_of(method, world))
    at, offsets, above, climbs = [], [], [], []
    frames, began = list(_frames(source, images)), time.process_time()
    for frame in frames:
        at.append(brain(frame).experience)
        offsets.append(brain.map.offset)
        above.append(_cells_3d(brain).now.rise_m if method != "plane" else 0.0)
        seen, v_m_s = brain.climb, cast(Velocity, frame.velocity).v_m_s
        climbs.append(frame.v_z_m_s if seen is None else seen.reckon(v_m_s))
    frame_ms = 1e3 * (time.process_time() - began) / len(frames)
    brain.map.solve()
    on_map, height = np.array(at), source.heights()
    poses = compose_poses(brain.map.poses[on_map], np.array(offsets))
    z = np.array(above)
    if method != "plane":
        z += _cells_3d(brain).experience_heights_m[on_map]
    first, links = brain.map.experiences["first_frame"].numpy(), brain.map.links
    made_at = height[first]
    wrong = np.abs(made_at[links.source] - made_at[links.target]) > STOREY_M / 2
    velocity, truth = source.odometry(), source.truths()
    speed, turn = velocity.T
    alone = integrate_velocities(speed, turn, np.full(len(at), _DT_S), source.truth(0))
    return Drive(
        truth=np.column_stack([truth[:, :2], height]),
        odometry=np.column_stack([alone[:, :2], np.cumsum(climbs) * _DT_S]),
        track=np.column_stack([poses[:, :2], z]),
        confused=on_another_storey(on_map, first, height, STOREY_M),
        wrong_links=int(wrong.sum()),
        loops=int(closes_loop(links.source, links.target).sum()),
        frame_ms=frame_ms,
    )


def _cells_3d(brain: NavigationBrain) -> PoseCells3D:
    return brain.pose_3d


def _cells_us(method: str, n: int = 2000) -> float:
    """Return the CPU time of a step of the cells alone, in microseconds."""
    config = config_of(method)
    in_3d = method != "plane"
    cells: PoseCells3D | PoseCellNetwork = PoseCellNetwork(config.pose_cells)
    if in_3d:
        cells = PoseCells3D(config.pose_cells, cast(Pose3DConfig, config.section("pose_3d")))
    more = (0.2,) if in_3d else ()
    motion = Motion(2.5, 0.3, _DT_S)
    for _ in range(100):
        cells.integrate(motion, *more)
    began = time.process_time()
    for _ in range(n):
        cells.integrate(motion, *more)
    return 1e6 * (time.process_time() - began) / n


def _row(
    world: str, method: str, drives: Sequence[Drive], cells_us: float | None
) -> dict[str, Any]:
    errors, alone = (
        np.array([_rms(error_in_3d(track, d.truth)) for d, track in pairs])
        for pairs in ([(d, d.track) for d in drives], [(d, d.odometry) for d in drives])
    )
    height = np.array([_rms(_height_errors(d)) for d in drives])
    flat = np.array([_rms(error_in_3d(_flat(d.track), _flat(d.truth))) for d in drives])
    return {
        "world": world,
        "height": method,
        "drives": len(drives),
        "drives_confused": sum(bool(d.confused.any()) for d in drives),
        "frames_confused_share": float(np.mean([d.confused.mean() for d in drives])),
        "links_between_storeys": int(sum(d.wrong_links for d in drives)),
        "loop_closures_median": float(np.median([d.loops for d in drives])),
        "ate_3d_median_m": float(np.median(errors)),
        "ate_3d_max_m": float(errors.max()),
        "height_rmse_median_m": float(np.median(height)),
        "ate_plane_median_m": float(np.median(flat)),
        "odometry_ate_3d_median_m": float(np.median(alone)),
        "worse_than_odometry": int((errors > alone).sum()),
        "brain_ms_a_frame": float(np.median([d.frame_ms for d in drives])),
        "cells_us_a_step": cells_us,
    }


def _height_errors(drive: Drive) -> np.ndarray:
    apart = drive.track[:, 2] - drive.truth[:, 2]
    return np.asarray(apart - apart.mean())


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors * errors)))


def _flat(points: np.ndarray) -> np.ndarray:
    return points * (1.0, 1.0, 0.0)


def _aligned(track: np.ndarray, truth: np.ndarray) -> np.ndarray:
    found = align(track[:, :2], truth[:, :2])
    up = track[:, 2] - track[:, 2].mean() + truth[:, 2].mean()
    return np.column_stack([track[:, :2] @ found.rotation.T + found.translation, up])


def _plot(found: Mapping[tuple[str, str], Sequence[Drive]]) -> Figure:
    seen, flat = found["garage", "seen"][0], found["garage", "plane"][0]
    drive = seen
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 7.6, "A garage of three storeys that look alike")
        tracks = (
            ("truth", drive.truth, TRUTH),
            ("odometry alone, height seen", _aligned(drive.odometry, drive.truth), ODOMETRY),
            ("map, height seen", _aligned(drive.track, drive.truth), MAP),
        )
        grid = figure.add_gridspec(2, 3, height_ratios=(1.25, 1.0))
        for column, (name, points, colour) in enumerate(tracks):
            axes = cast(Axes3D, figure.add_subplot(grid[0, column], projection="3d"))
            axes.plot(*points.T, color=colour, lw=0.9)
            axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
            axes.set(xticks=[-8, 0, 8], yticks=[-8, 0, 8], zticks=[0, 2, 4, 6])
            axes.set(zlim=(-1.0, 7.0))
            axes.set_box_aspect((1.3, 1.0, 0.75))
            axes.view_init(elev=22, azim=-58)
            error = _rms(error_in_3d(points, drive.truth))
            axes.set_title(name if name == "truth" else f"{name}: ATE {error:.2f} m", y=0.97)
        figure.add_subplot(grid[1, :2])
        _plot_heights(figure.axes[-1], found["garage", "given"][0], seen, flat)
        figure.add_subplot(grid[1, 2])
        _plot_shares(figure.axes[-1], found)
    return figure


def _plot_heights(axes: Any, given: Drive, seen: Drive, flat: Drive) -> None:  # noqa: ANN401
    minutes = np.arange(len(seen.truth)) * _DT_S / 60.0
    axes.plot(minutes, seen.truth[:, 2], color=TRUTH, lw=2.5, label="truth")
    axes.plot(minutes, seen.odometry[:, 2], color=ODOMETRY, lw=1.2, label="seen, odometry alone")
    axes.plot(minutes, seen.track[:, 2], color=MAP, lw=1.2, label="seen, map")
    axes.plot(minutes, given.track[:, 2], color=MAP, lw=1.2, ls=":", label="given, map")
    for i, (one, colour, name) in enumerate(
        ((flat, LOOP, "in the plane on another storey"), (seen, MAP, "seen, on another storey"))
    ):
        where = np.flatnonzero(one.confused)
        axes.plot(minutes[where], np.full(len(where), -0.7 - 0.5 * i), "|", color=colour, ms=5,
                  label=f"{name}: {len(where)} of {len(minutes)} frames")  # fmt: skip
    axes.set(xlabel="time (min)", ylabel="height (m)", ylim=(-1.6, 11.0))
    axes.legend(loc="upper left", ncols=2)
    write_title(axes, "Height, and frames at which storeys are confused", "first drive")


def _plot_shares(
    axes: Any,  # noqa: ANN401 - of matplotlib
    found: Mapping[tuple[str, str], Sequence[Drive]],
) -> None:
    labels = []
    for k, ((world, method), each) in enumerate(found.items()):
        share = np.array([100.0 * d.confused.mean() for d in each])
        spread = np.linspace(-0.25, 0.25, len(share)) if len(share) > 1 else np.zeros(1)
        axes.plot(k + spread, share, ".", color=LOOP if method == "plane" else MAP, ms=4)
        n = sum(bool(d.confused.any()) for d in each)
        labels.append(f"{world}, {method}: {n} of {len(each)}")
    axes.set_xticks(range(len(labels)), labels, rotation=35, ha="right", rotation_mode="anchor")
    axes.set(ylabel="frames on another storey (%)", ylim=(-3.0, None))
    write_title(axes, "Each drive", "drives confused")
