"""The incremental solver beside iSAM2, on the streams of poses and links that gtsam ships.

Without gtsam there is nothing to compare with, and no rows. The table takes the first 2500 poses of
each stream; ``python -m benchmarks.bench_pose_graph`` takes the streams whole, a few minutes.
"""

import importlib.util
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.timing import Row, written
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.incremental import IncrementalSolver

NO_LINKS = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0), np.empty(0))
FIRST_POSES = 2500


class Stream(NamedTuple):
    """Links in the order in which a robot measured them; ``groups`` are those of one update."""

    source: np.ndarray
    target: np.ndarray
    measured: np.ndarray  # x and y in metres, turn; NaN for a landmark, which has no heading
    scale: np.ndarray  # 1 / sigma
    groups: list[np.ndarray]


def folder() -> Path | None:
    spec = importlib.util.find_spec("gtsam")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent / "Data"


def read(path: Path) -> Stream:
    """Read ``w10000.graph`` (every link from the newest pose) or ``victoria_park.txt``."""
    lines = [line.split() for line in path.read_text().splitlines()]
    lines = [line for line in lines if line[0] in ("EDGE2", "ODOMETRY", "LANDMARK")]
    measured, scale = np.full((len(lines), 3), np.nan), np.ones((len(lines), 3))
    for k, (kind, _, _, *numbers) in enumerate(lines):
        values = [float(number) for number in numbers]
        measured[k, : 2 if kind == "LANDMARK" else 3] = values[: 2 if kind == "LANDMARK" else 3]
        if kind != "EDGE2":  # covariances: upper triangle of 3 by 3, or of 2 by 2
            at = (2, 4) if kind == "LANDMARK" else (3, 6, 8)
            scale[k, : len(at)] = [values[i] ** -0.5 for i in at]
    source, target = np.array([[int(line[1]), int(line[2])] for line in lines]).T
    odometry = np.array([line[0] == "ODOMETRY" for line in lines])
    step = np.cumsum(odometry) if odometry.any() else np.maximum(source, target)
    groups = np.split(np.arange(len(lines)), np.flatnonzero(np.diff(step)) + 1)
    return Stream(source, target, measured, scale, groups)


def ahead(pose: np.ndarray, moved: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = 0.0 if np.isnan(moved[2]) else moved[2]
    x, y = cos * moved[0] - sin * moved[1], sin * moved[0] + cos * moved[1]
    return pose + np.array([x, y, turn])


def back(moved: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(moved[2]), np.sin(moved[2])
    return np.array([-cos * moved[0] - sin * moved[1], sin * moved[0] - cos * moved[1], -moved[2]])


def squared_error(poses: np.ndarray, stream: Stream, links: np.ndarray) -> float:
    theta = poses[stream.source[links], 2]
    cos, sin = np.cos(theta), np.sin(theta)
    dx, dy, turn = (poses[stream.target[links]] - poses[stream.source[links]]).T
    seen = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=1)
    off = seen - stream.measured[links]
    off[:, 2] = np.nan_to_num(wrap_angles(off[:, 2]))
    return float(((off * stream.scale[links]) ** 2).sum())


def ours(stream: Stream, updates: int) -> tuple[np.ndarray, float, float]:
    """Return the times of the updates in ms, the error after the last, and after a solution."""
    solver = IncrementalSolver(*NO_LINKS)
    distance = np.hypot(*stream.measured[:, :2].T)
    heading = np.arctan2(stream.measured[:, 1], stream.measured[:, 0])
    poses, known = np.zeros((1 + max(stream.source.max(), stream.target.max()), 3)), {0}
    times, top = [], 0
    for group in stream.groups[:updates]:
        for k in group:
            s, t, moved = int(stream.source[k]), int(stream.target[k]), stream.measured[k]
            if t not in known:
                poses[t] = ahead(poses[s], moved)
            elif s not in known:
                poses[s] = ahead(poses[t], back(moved))
            known |= {s, t}
            top = max(top, s, t)
        began, since = time.process_time(), solver.n
        for k in group:
            ends = int(stream.source[k]), int(stream.target[k])
            far = float(distance[k]), float(heading[k]), float(stream.measured[k, 2])
            solver.add_link(*ends, *far, scale=tuple(stream.scale[k]))
        solver.update(poses[: top + 1], since)
        times.append(1e3 * (time.process_time() - began))
    links = np.concatenate(stream.groups[:updates])
    online = squared_error(poses, stream, links)
    solver.solve(poses[: top + 1])
    return np.array(times), online, squared_error(poses, stream, links)


def isam2(stream: Stream, updates: int) -> tuple[np.ndarray, float]:
    """Return the times of gtsam's updates, with its default thresholds, and the error at last."""
    import gtsam

    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    graph, fresh = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(0, 0, 0), fixed))
    fresh.insert(0, gtsam.Pose2(0, 0, 0))
    landmarks = set(stream.target[np.isnan(stream.measured[:, 2])].tolist())
    known, now, times = {0}, {0: np.zeros(3)}, []

    def at(i: int) -> np.ndarray:
        if i not in now:
            pose = isam.calculateEstimatePose2(i)
            now[i] = np.array([pose.x(), pose.y(), pose.theta()])
        return now[i]

    for group in stream.groups[:updates]:
        for k in group:
            s, t, moved = int(stream.source[k]), int(stream.target[k]), stream.measured[k]
            sigma = 1.0 / stream.scale[k]
            if t in landmarks:
                far = float(np.hypot(moved[0], moved[1]))
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma[1] / far, sigma[0]]))
                bearing = gtsam.Rot2(float(np.arctan2(moved[1], moved[0])))
                graph.add(gtsam.BearingRangeFactor2D(s, t, bearing, far, noise))
            else:
                noise = gtsam.noiseModel.Diagonal.Sigmas(sigma)
                graph.add(gtsam.BetweenFactorPose2(s, t, gtsam.Pose2(*moved), noise))
            for new, pose in ((t, lambda s=s, m=moved: ahead(at(s), m)),
                              (s, lambda t=t, m=moved: ahead(at(t), back(m)))):  # fmt: skip
                if new not in known:
                    now[new] = pose()
                    value = gtsam.Point2(*now[new][:2]) if new in landmarks else None
                    fresh.insert(new, gtsam.Pose2(*now[new]) if value is None else value)
                    known.add(new)
        began = time.process_time()
        isam.update(graph, fresh)
        times.append(1e3 * (time.process_time() - began))
        graph, fresh, now = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
    values, poses = isam.calculateEstimate(), np.zeros((1 + max(known), 3))
    for i in known:
        if i in landmarks:
            poses[i, :2] = values.atPoint2(i)
        else:
            pose = values.atPose2(i)
            poses[i] = pose.x(), pose.y(), pose.theta()
    return np.array(times), squared_error(poses, stream, np.concatenate(stream.groups[:updates]))


def compare(name: str, updates: int) -> Row:
    data = folder()
    assert data is not None
    stream = read(data / name)
    times, online, solved = ours(stream, updates)
    theirs, error = isam2(stream, updates)

    def said(of: np.ndarray) -> str:
        return f"p99 {written(np.percentile(of, 99))}, largest {written(of.max())}"

    return Row(
        "incremental update",
        f"{name}, {len(times)} poses",
        float(times[1:].mean()),
        "",
        f"iSAM2 {written(theirs[1:].mean())}, {said(theirs[1:])}; squared error {error:.5g}",
        f"{said(times[1:])}; squared error {online:.5g}, solved {solved:.5g}",
    )


def rows(updates: int = FIRST_POSES) -> list[Row]:
    if folder() is None:
        return []
    return [compare(name, updates) for name in ("victoria_park.txt", "w10000.graph")]


if __name__ == "__main__":
    for row in rows(int(sys.argv[1]) if len(sys.argv) > 1 else sys.maxsize):
        print(f"{row.size}: ours {written(row.ms)}, {row.more}; {row.beside}")
