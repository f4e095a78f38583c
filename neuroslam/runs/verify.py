"""Consistency checks of a brain file or a run folder."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from neuroslam.brain import NavigationBrain, read_checkpoint
from neuroslam.brain.soundness import faults_of
from neuroslam.errors import NeuroslamError, counted, first_line, listed
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.geometry import wrap_angles
from neuroslam.runs.files import (
    brain_file,
    experiences_csv,
    links_csv,
    missing_rows,
)
from neuroslam.runs.heights import frame_heights
from neuroslam.runs.manifest import manifest_faults, read_manifest
from neuroslam.runs.reading import frame_rows, read_metrics, read_plan, read_trace, trajectory
from neuroslam.state.answers import gathered, tables_of

_MAY_BE_INFINITE = ("map.goals.until_s",)  # a goal without an end time


def verify(path: str | Path) -> list[str]:
    """Return the faults of a brain, or the contradictions between a run folder and its brain.

    The SHA-256 of a file shows that it is unaltered; ``verify`` checks its content: ids exist,
    numbers are finite, every experience has one origin, the map is connected, and every population
    finds its own state valid.

    Args:
        path: Brain file, or folder of a run.

    Returns:
        One line for each kind of fault, with its location; empty if there is none.
    """
    path = Path(path)
    try:
        config, state = read_checkpoint(brain_file(path))
    except NeuroslamError as error:
        return [str(error)]
    model = NavigationBrain(config)
    faults = faults_of(state, model)
    if faults:
        return faults
    try:
        model.load_state_dict(state)
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        return [f"its state does not fit its config ({first_line(error)})"]
    if path.is_dir() and not faults:  # files cannot agree with a faulty brain
        try:
            faults = list(_folder_faults(path, model)) or manifest_faults(path)
        except NeuroslamError as error:  # the manifest is damaged
            faults = [str(error)]
    return faults


def _folder_faults(out: Path, brain: NavigationBrain) -> Iterator[str]:
    """Yield the files of a run that differ from its brain, or cannot be read."""
    saved = read_manifest(out)
    if saved is not None and "trajectory.tum" not in saved:  # a save during the run
        yield f"{out}: the run was cut off; continue it with: neuroslam resume {out}"
        return
    for read in (read_plan, read_metrics):
        try:
            read(out)
        except NeuroslamError as error:
            yield str(error)
    shown = brain.largest
    expected = {
        "experiences.csv": experiences_csv(shown),
        "links.csv": links_csv(shown.map.links, shown.map.link_weights),
    }
    if _header(out / "links.csv") == links_csv(shown.map.links).splitlines()[0]:
        expected["links.csv"] = links_csv(shown.map.links)  # of a version without weights
    expected |= gathered(shown.populations.values(), tables_of)
    for name, text in expected.items():
        fault = _table_fault(out / name, text)
        if fault:
            yield f"{out / name}: {fault}"
    seen = brain.clock.frames_seen
    try:
        rows = len(frame_rows(out))
    except NeuroslamError as error:
        yield str(error)
        return
    if rows == 0 and brain.sessions.merges:
        return  # merged from brain files: no frames, no trajectory
    if rows < seen:
        yield missing_rows(out, rows, seen)
    elif rows > seen:
        yield (
            f"{out / 'frames.csv'}: {counted(rows, 'row')}, the brain has seen "
            f"{counted(seen, 'frame')}; the run was cut off: resume it"
        )
    try:
        trace = read_trace(out, seen)
        poses = trajectory(shown, trace)
        on_map = np.isfinite(poses[:, 0])
        if not on_map.any():
            return  # all frames are on maps that were not joined
        track = read_tum(out / "trajectory.tum")
    except NeuroslamError as error:
        yield str(error)
        return
    if len(track.poses) != on_map.sum():
        yield f"{out / 'trajectory.tum'}: {len(track.poses)} poses; expected {on_map.sum()}"
        return
    apart = track.poses - poses[on_map]
    apart[:, 2] = wrap_angles(apart[:, 2])
    far = (np.abs(apart) > 1e-6).any(1)
    z_m = frame_heights(shown, trace, out)
    if z_m is not None:
        there = 0.0 if track.heights_m is None else track.heights_m
        far |= np.abs(there - z_m[on_map]) > 1e-6
    wrong = np.flatnonzero(far)
    if len(wrong):
        yield f"{out / 'trajectory.tum'}: poses {listed(wrong)} differ from the brain"


def _table_fault(path: Path, expected: str) -> str:
    columns, *should = expected.splitlines()
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
        if header != columns:
            return f"its columns are {header!r}; expected {columns!r}"
        text = {i for line in should for i, cell in enumerate(line.split(",")) if _is_text(cell)}
        rows = [_values(line, columns, text) for line in lines]
    except (OSError, ValueError) as error:
        return f"cannot be read ({_why(error)})"
    if len(rows) != len(should):
        return f"{counted(len(rows), 'row')}; expected {len(should)} as in the brain"
    differ = [i for i, (row, line) in enumerate(zip(rows, should, strict=True))
              if row != _values(line, columns, text)]  # fmt: skip
    return f"rows {listed(differ)} differ from the brain" if differ else ""


def _header(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as opened:
            return opened.readline().rstrip("\n")
    except (OSError, ValueError):
        return ""  # why not, is said where the rows are read


def _values(line: str, columns: str, text: set[int]) -> list[str | float]:
    """Parse a row of a CSV table: text in the columns that hold text, numbers in all others.

    Raises:
        ValueError: If the row has too few or too many values, or one is not a number.

    Example:
        >>> _values("landmark_1,0.50,3", "name,x_m,seen", {0})
        ['landmark_1', 0.5, 3.0]
    """
    cells, n = line.split(","), columns.count(",") + 1
    if len(cells) != n:
        raise ValueError(f"a row has {counted(len(cells), 'value')}; expected {n}")
    return [cell if i in text else float(cell) for i, cell in enumerate(cells)]


def _is_text(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return True
    return False


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
