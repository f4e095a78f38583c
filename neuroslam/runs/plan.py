"""The quickest path from the robot, or any experience, to another experience of a map."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import RunError, counted
from neuroslam.figures.maps import plot_map
from neuroslam.figures.style import save
from neuroslam.runs.files import brain_file, write_text
from neuroslam.runs.reading import length_unit


class PlannedPath(NamedTuple):
    """A planned path.

    Attributes:
        path: Experiences from start to goal, both included.
        length_m: Sum of the lengths of its links on the map.
        duration_s: Sum of the durations of its links, as they were driven.
        beside_m: Distance from the position that was asked for to the last experience; 0 if an
            experience was asked for.
        files: ``plan.csv`` and ``plan.png``.
        unit: Unit of the lengths: ``m``, or ``arbitrary unit`` for one camera alone.
    """

    path: list[int]
    length_m: float
    duration_s: float
    beside_m: float
    files: list[Path]
    unit: str = "m"


def plan(
    path: str | Path, goal: str, out: str | Path | None = None, start: str | None = None
) -> PlannedPath:
    """Plan the quickest path to an experience or a position, and write it as a table and a figure.

    Args:
        path: Brain file, or folder of a run.
        goal: Id of an experience, or ``x,y`` in metres on the map: the experience nearest to it.
        out: Folder of ``plan.csv`` and ``plan.png``; the run's own if not given.
        start: Like ``goal``; the experience where the robot is if not given.

    Raises:
        CheckpointError: If the brain cannot be read.
        RunError: If start or goal is neither, lies farther from the map than the map is large, or
            no links lead from one to the other.
    """
    file = brain_file(path)
    brain, out = load_brain(file).largest, Path(file.parent if out is None else out)
    if not brain.map.n:
        raise RunError(f"{path}: the map has no experiences; there is nowhere to go")
    end, beside_m = _experience(brain, goal, "goal")
    begin = brain.map.state.current if start is None else _experience(brain, start, "start")[0]
    found = brain.map.plan(end, begin)
    if not found.path:
        raise RunError(f"no path to {goal}: {found.reason}")
    poses = brain.map.poses[found.path]
    length_m = float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())
    rows = zip(found.path, poses.tolist(), strict=True)
    lines = [f"{k},{e},{x!r},{y!r},{t!r}" for k, (e, (x, y, t)) in enumerate(rows)]
    links, unit = brain.map.links, length_unit(file)
    figure = plot_map(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        current=brain.map.pose,
        landmarks=brain.landmarks_m,
        planned=poses[:, :2],
        title=f"Path from experience {begin} to {end}\n"
        f"{counted(len(found.path) - 1, 'link')}, {length_m:.1f} {unit}, {found.duration_s:.1f} s",
        unit=unit,
    )
    files = [out / "plan.csv", out / "plan.png"]
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_text(files[0], "\n".join(["step,experience,x_m,y_m,theta_rad", *lines]) + "\n")
        save(figure, files[1])
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return PlannedPath(found.path, length_m, found.duration_s, beside_m, files, unit)


def _experience(brain: NavigationBrain, text: str, what: str) -> tuple[int, float]:
    """Return the experience that a user names, and how far it is from the position given."""
    n = brain.map.n
    if text.strip().isdecimal():
        if int(text) >= n:
            raise RunError(
                f"{what} {text}: no such experience; the map has {counted(n, 'experience')}, "
                f"0 to {n - 1}"
            )
        return int(text), 0.0
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise RunError(
            f"{what} {text!r}: expected the id of an experience, such as 12, or a position x,y in "
            "metres, such as 1.5,-2"
        )
    at = brain.map.poses[:, :2]
    away = np.hypot(*(at - (x, y)).T)
    nearest, size = int(away.argmin()), float(np.hypot(*np.ptp(at, axis=0)))
    if n > 1 and away[nearest] > size:
        raise RunError(
            f"{what} {text}: {away[nearest]:.1f} from the nearest experience, and the map is "
            f"{size:.1f} from corner to corner; expected a position on the map, in its unit"
        )
    return nearest, float(away[nearest])
