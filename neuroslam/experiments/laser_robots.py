"""Real robots with a laser and no camera: maps from views of scans, beside odometry.

Data: CARMEN logs of the ACES building and the Intel Research Lab. Compared are the wheels, scan
odometry (:mod:`neuroslam.odometry.scans`), RatSLAM with views of scans, and a map whose loops are
proposed by views and by place, and measured by registration of scans. All settings were fixed on
Intel; ACES was looked at afterwards.
"""

import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain
from neuroslam.config import MapConfig, ViewConfig, build_config
from neuroslam.errors import SourceError
from neuroslam.evaluation.relations import read_relations, relation_errors
from neuroslam.figures.style import MAP, ODOMETRY, save
from neuroslam.geometry import (
    compose_poses,
    relative_poses,
    rotate_points,
)
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.odometry.scans import KnownSurfaces, ScanOdometry, Surfaces, surfaces_in_scan
from neuroslam.sensors.carmen import CarmenSource
from neuroslam.sensors.open import open_source
from neuroslam.state.files import write_atomically
from neuroslam.types import Frame, Pose, PoseEstimate
from neuroslam.view.scan_view import scan_picture
from neuroslam.view.templates import LocalViewCells

ROBOTS = ("intel", "aces")
"""Logs of the experiment, the one that the settings were fixed on first."""

VIEW: dict[str, Any] = {
    "template_width": 90,
    "template_height": 1,
    "crop": [90, 270, 0, 1],  # the half turn ahead that these lasers see
    "shift_match": 6,
    "min_contrast": 0.0,
}
"""Views of scans of half a turn, 2 degrees a column."""

STEP_M, STEP_RAD = 0.5, 0.5
"""Motion after which an experience is made."""

DRIFT, LEAST_M, NEAR_M = 0.02, 0.5, 2.0
"""Correction of a believed loop: at most this share of the path since, and so many metres more;
candidates lie within that of the robot, and so many metres more."""

TURN_RAD = 0.2
"""Largest correction of the heading by a loop."""

APART = 40
"""Experiences made since a candidate, at least."""

AROUND = 6
"""Experiences before and after a candidate whose surfaces a scan is registered to."""

SHARE, RMS_M = 0.8, 0.06
"""Share of a scan that lies on the surfaces of a believed loop, and its largest residual."""

LEAST_INFORMATION = 1.0 / 0.1**2
"""Information of the surfaces about the direction that they show least, per square metre."""

_BY_VIEW, _BY_PLACE = 4, 2  # candidates
_DRAWN_M = 15.0  # farther ranges are not drawn
_CELL_M = 0.1
_NO_CELLS = PoseEstimate(0.0, 0.0, 0.0)


class Track(NamedTuple):
    """Poses at the times of the scans, and figures of how they were made."""

    times_s: np.ndarray
    poses: np.ndarray
    loops: int
    experiences: int
    ms_per_frame: float


class LaserMapper:
    """Maps scans: odometry by registration, experiences, and loops that scans confirm.

    Args:
        view: Views of scans, which rank the candidates of a loop.

    Attributes:
        map: Experience map; its loop closures have the measured displacement.
        loops: Pairs of experiences that were linked as a loop.
    """

    def __init__(self, view: ViewConfig) -> None:
        self.map = ExperienceMap(MapConfig(solver="incremental", robust=True))
        self.views = LocalViewCells(view)
        self.odometry = ScanOdometry()
        self.loops: list[tuple[int, int]] = []
        self._scans: list[Surfaces] = []
        self._path_m: list[float] = []
        self._way_m, self._before = 0.0, Pose(0.0, 0.0, 0.0)

    def __call__(self, frame: Frame, dt_s: float) -> tuple[int, Pose]:
        """Advance by a scan; return the experience, and the robot's pose relative to it."""
        assert frame.ranges is not None
        assert frame.velocity is not None
        now = self.odometry(frame.ranges, frame.velocity, dt_s)
        step = relative_poses(np.array(self._before), np.array(now))
        self._before = now
        self._way_m += math.hypot(step[0], step[1])
        self._move_to(compose_poses(np.array(self.map.pose), step))
        offset = self.map.offset
        moved = math.hypot(offset.x_m, offset.y_m) > STEP_M or abs(offset.theta_rad) > STEP_RAD
        if not self.map.n or moved:
            self._arrive(frame)
        return self.map.current, self.map.offset

    def _move_to(self, pose: np.ndarray) -> None:
        self.map.set_pose(Pose(*pose.tolist()))

    def _arrive(self, frame: Frame) -> None:
        """Make an experience, and link it to an earlier one that the scan shows again."""
        assert frame.ranges is not None
        view = self.views.encode(scan_picture(frame.ranges))
        errors, _ = self.views.compare(view)
        new = self.map.create(self.views.learn(view), _NO_CELLS, frame.index)
        scan = surfaces_in_scan(frame.ranges)
        found = self._loop(new, scan, errors) if new >= APART else None
        self._scans.append(scan)
        self._path_m.append(self._way_m)
        if found is None:
            return
        target, measured = found
        here = np.array(self.map.poses[new])
        self._move_to(compose_poses(here, measured))  # where the target is, seen from here
        self.map.link(target)
        self.map.relax()
        self.map.relocalise(new)
        self._path_m[new] = self._path_m[target]  # no drift since
        self.loops.append((new, target))

    def _loop(self, new: int, scan: Surfaces, errors: np.ndarray) -> tuple[int, np.ndarray] | None:
        """Return the experience that a scan shows again, and its pose relative to the new one."""
        poses = self.map.poses
        old = np.arange(new - APART + 1)
        apart = np.hypot(*(poses[old, :2] - poses[new, :2]).T)
        reach = LEAST_M + DRIFT * np.abs(self._way_m - np.array(self._path_m)[old])
        near = old[apart <= reach + NEAR_M]
        if not len(near):
            return None
        by_view = near[np.argsort(errors[near])[:_BY_VIEW]]
        by_place = near[np.argsort(apart[near])[:_BY_PLACE]]
        best: tuple[float, int, np.ndarray] | None = None
        for target in dict.fromkeys([*by_view.tolist(), *by_place.tolist()]):
            around = range(max(target - AROUND, 0), min(target + AROUND + 1, len(old)))
            frame = poses[target]
            seen = [
                self._scans[one].at(Pose(*relative_poses(frame, poses[one]).tolist()))
                for one in around
            ]
            expected = relative_poses(frame, poses[new])
            got = KnownSurfaces(seen).register(
                scan,
                Pose(*expected.tolist()),
                0.5 * float(reach[target]),
                0.5 * TURN_RAD,
                reach_m=1.0,
            )
            dx, dy, turn = relative_poses(expected, np.array(got.pose)).tolist()
            good = math.hypot(dx, dy) <= reach[target] and abs(turn) <= TURN_RAD
            good &= got.share >= SHARE and got.rms_m <= RMS_M
            good &= np.linalg.eigvalsh(got.information[:2, :2])[0] >= LEAST_INFORMATION
            if good and (best is None or got.share > best[0]):
                back = relative_poses(np.array(got.pose), np.zeros(3))
                best = got.share, target, back
        return None if best is None else (best[1], best[2])


def laser_robots(data_folder: Path, out_folder: Path) -> dict[str, Any]:
    """Map each log with each method; write ``results.json`` and a picture of each robot's map.

    Args:
        data_folder: Holds ``intel.clf.bz2``, ``aces.clf.bz2`` and ``aces.relations``.
        out_folder: Folder to write.

    Returns:
        The content of ``results.json``: a row for each log and method, with the mean errors of the
        true relations where there are any, over all and over those whose ends are more than 100 s
        apart.

    Raises:
        SourceError: If a log is missing or is none.
    """
    rows: list[dict[str, Any]] = []
    out = Path(out_folder)
    for robot in ROBOTS:
        log = open_log(Path(data_folder) / f"{robot}.clf.bz2")
        tracks = {name: method(log) for name, method in METHODS.items()}
        truth = Path(data_folder) / f"{robot}.relations"
        for name, track in tracks.items():
            row = {"robot": robot, "method": name, **figures(track, truth)}
            row["occupied_m2"] = round(float((occupancy(log, track) > 0).sum()) * _CELL_M**2, 1)
            rows.append(row)
        shown = {name: tracks[name] for name in ("odometry", "views and scans")}
        save(draw(log, robot, shown), out / f"{robot}.png")
    results = {"experiment": "laser_robots", "rows": rows}
    text = json.dumps(results, indent=1) + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    return results


def open_log(path: Path) -> CarmenSource:
    """Open the log of a robot with a laser.

    Raises:
        SourceError: If it is missing, or no CARMEN log.
    """
    source = open_source(path)
    if not isinstance(source, CarmenSource):
        raise SourceError(f"{path}: is no CARMEN log; expected scans and odometry")
    return source


def figures(track: Track, truth: Path) -> dict[str, Any]:
    """Return the row of a track: its errors, if there are true relations, and its counts."""
    row: dict[str, Any] = {}
    if truth.is_file():
        errors = relation_errors(track.times_s, track.poses, read_relations(truth))
        row = {
            "relations": len(errors.far),
            "error_m": round(float(errors.translation_m.mean()), 4),
            "error_deg": round(math.degrees(float(errors.rotation_rad.mean())), 3),
            "far_relations": int(errors.far.sum()),
            "far_error_m": round(float(errors.translation_m[errors.far].mean()), 3),
        }
    return row | {
        "experiences": track.experiences,
        "loops": track.loops,
        "ms_per_frame": round(track.ms_per_frame, 2),
    }


def wheels(log: CarmenSource) -> Track:
    """Return the track of the wheels."""
    times, poses = [], []
    for frame, _ in timed(log):
        times.append(frame.time_s)
        poses.append(log.odometry[frame.index])
    return Track(np.array(times), np.array(poses), 0, 0, 0.0)


def scan_odometry(log: CarmenSource) -> Track:
    """Return the track of scan odometry alone."""
    odometry = ScanOdometry()

    def step(frame: Frame, dt_s: float) -> tuple[int, Pose]:
        assert frame.ranges is not None
        assert frame.velocity is not None
        return 0, odometry(frame.ranges, frame.velocity, dt_s)

    return followed(log, step, lambda: np.zeros((1, 3)), lambda: (0, 0))


def views_alone(log: CarmenSource) -> Track:
    """Return the track of RatSLAM with views of scans: pose cells, one view closes a loop."""
    values = {
        "frame_rate_hz": 5.0,
        "max_gap_s": 10.0,
        "odometry": {"use": "given"},
        "sessions": {"kidnapped": "ignore"},
        "view": VIEW | {"threshold": 0.02},
        "map": {"closure": "view", "solver": "incremental", "robust": True},
    }
    brain = NavigationBrain(build_config(values))
    loops = 0

    def step(frame: Frame, _: float) -> tuple[int, Pose]:
        nonlocal loops
        assert frame.ranges is not None
        result = brain(frame._replace(image=scan_picture(frame.ranges)))
        loops += result.action == "link"
        return max(result.experience, 0), brain.map.offset

    return followed(log, step, lambda: brain.map.poses, lambda: (loops, brain.map.n))


def views_and_scans(log: CarmenSource) -> Track:
    """Return the track of a map whose loops views propose and scans measure."""
    mapper = LaserMapper(ViewConfig(**VIEW))
    return followed(
        log, mapper, lambda: mapper.map.poses, lambda: (len(mapper.loops), mapper.map.n)
    )


METHODS: dict[str, Callable[[CarmenSource], Track]] = {
    "odometry": wheels,
    "scan odometry": scan_odometry,
    "RatSLAM, views of scans": views_alone,
    "views and scans": views_and_scans,
}
"""Name -> method."""


def timed(log: CarmenSource) -> Iterator[tuple[Frame, float]]:
    """Yield each usable frame with the time since the one before."""
    before_s: float | None = None
    for frame in log.frames(on_bad_frame=lambda _: None):
        yield frame, 0.1 if before_s is None else frame.time_s - before_s
        before_s = frame.time_s


def followed(
    log: CarmenSource,
    step: Callable[[Frame, float], tuple[int, Pose]],
    experiences: Callable[[], np.ndarray],
    counts: Callable[[], tuple[int, int]],
) -> Track:
    """Take every scan, then place each relative to its experience on the finished map."""
    times, ids, offsets, began_s = [], [], [], time.process_time()
    for frame, dt_s in timed(log):
        at, offset = step(frame, dt_s)
        times.append(frame.time_s)
        ids.append(at)
        offsets.append(offset)
    cpu_s = time.process_time() - began_s
    poses = compose_poses(experiences()[ids], np.array(offsets))
    return Track(np.array(times), poses, *counts(), 1e3 * cpu_s / max(len(times), 1))


def occupancy(log: CarmenSource, track: Track) -> np.ndarray:
    """Count the ends of beams in each cell of a grid of 0.1 m, ``(n_y, n_x)``."""
    return _grid(log, track)[0]


def _grid(log: CarmenSource, track: Track) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    ends = []
    for row, (frame, _) in enumerate(timed(log)):
        if row % 3 or frame.ranges is None:  # scans overlap
            continue
        r = frame.ranges
        bearings = np.arange(len(r)) * (2.0 * np.pi / len(r))
        near = r < _DRAWN_M
        points = np.column_stack(
            [r[near] * np.cos(bearings[near]), r[near] * np.sin(bearings[near])]
        )
        ends.append(rotate_points(points, track.poses[row, 2]) + track.poses[row, :2])
    points = np.concatenate(ends)
    low = points.min(axis=0) - 1.0
    cells = ((points - low) / _CELL_M).astype(np.int64)
    n_x, n_y = cells.max(axis=0) + 10
    grid = np.zeros((n_y, n_x))
    np.add.at(grid, (cells[:, 1], cells[:, 0]), 1.0)
    return grid, (low[0], low[0] + n_x * _CELL_M, low[1], low[1] + n_y * _CELL_M)


def draw(log: CarmenSource, robot: str, tracks: dict[str, Track]) -> Figure:
    """Draw the scans at the poses of each track, with its path."""
    figure = Figure(figsize=(7.0 * len(tracks), 7.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(tracks)))
    for axes, (name, track) in zip(panels, tracks.items(), strict=True):
        grid, extent = _grid(log, track)
        axes.imshow(np.log1p(grid), origin="lower", cmap="gray_r", extent=extent, vmax=4.0)
        colour = ODOMETRY if name == "odometry" else MAP
        axes.plot(*track.poses[:, :2].T, color=colour, lw=0.8, label="path")
        loops = f", {track.loops} loop closures" if track.loops else ""
        axes.set(
            xlabel="x (m)", ylabel="y (m)", title=f"{robot}: scans at the poses of {name}{loops}"
        )
        axes.legend(loc="upper left", frameon=False)
    return figure
