"""What a finished run left in its folder, read and checked once."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import NeuroslamError, RunError
from neuroslam.runs.files import (
    RunPlan,
    brain_file,
    frame_rows,
    read_actions,
    read_frames,
    read_metrics,
    read_plan,
    read_trace,
)

CURVES = ("cells/peak", "cells/doubt_s", "map/largest_correction")
"""What a page shows of ``events/``: scalars that no other file of a run has."""


class Curve(NamedTuple):
    """A scalar over a run: rows of ``frames.csv`` and the values there, arrays of one length."""

    rows: np.ndarray
    values: np.ndarray


class FinishedRun(NamedTuple):
    """The files of a run; ``frames`` and ``trace`` have a row a frame, or none after a merge."""

    out: Path
    plan: RunPlan
    brain: NavigationBrain
    frames: dict[str, np.ndarray]
    actions: np.ndarray
    trace: dict[str, np.ndarray]
    metrics: dict[str, Any]
    curves: dict[str, Curve]


def read_run(out: str | Path) -> FinishedRun:
    """Read the folder that ``run``, ``resume`` or ``merge`` wrote.

    Rows that a killed run wrote after its last save are left out.

    Raises:
        RunError: If the folder holds no run, or a file of it is missing or damaged.
        CheckpointError: If its brain cannot be loaded.
    """
    out = Path(out)
    if not out.is_dir():
        what = "is a file" if out.exists() else "no such folder"
        raise RunError(f"{out}: {what}; expected the folder of a run")
    plan, brain = read_plan(out), load_brain(out / "brain.safetensors")
    rows = brain.clock.frames_seen
    if brain.sessions.merges and not frame_rows(out, 1):
        rows = 0  # two brain files were merged: nobody knows their frames
    frames, actions = read_frames(out, rows), read_actions(out, rows)
    trace = read_trace(out, rows or None, min_rows=0)
    return FinishedRun(
        out,
        plan,
        brain,
        frames,
        actions,
        {name: column[:rows] for name, column in trace.items()},
        read_metrics(out),
        read_curves(out, frames["frame"]),
    )


def read_curves(out: Path, frames: np.ndarray) -> dict[str, Curve]:
    """Read ``CURVES`` from the TensorBoard events of a run; those that there are.

    Args:
        out: Folder of the run.
        frames: Number of the frame of each row, rising.
    """
    files = sorted((out / "events").glob("events.out.tfevents.*"))
    if not files or not len(frames):
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tensorboard's, of what it imports
        from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
    found: dict[str, dict[int, float]] = {name: {} for name in CURVES}
    for file in files:
        for event in EventFileLoader(str(file)).Load():
            for value in event.summary.value:
                if value.tag in found:  # of a frame that was seen twice the later counts
                    found[value.tag][int(event.step)] = float(value.tensor.float_val[0])
    curves = {}
    for name, points in found.items():
        steps = np.array(sorted(points), dtype=np.int64)
        rows = np.searchsorted(frames, steps)
        there = rows < len(frames)
        there[there] = frames[rows[there]] == steps[there]
        if there.any():
            values = np.array([points[step] for step in steps[there].tolist()])
            curves[name] = Curve(rows[there], values)
    return curves


def session_plans(run: FinishedRun) -> dict[int, RunPlan]:
    """Find what each session of a map was driven through, as far as the runs are still there.

    A run's folder names its own source, and the stored maps that it went on in; the folders of
    those name theirs.

    Returns:
        Session id to the plan of the run it was made in.
    """
    plans: dict[int, RunPlan] = {}
    asked: set[Path] = set()
    left: list[tuple[RunPlan, NavigationBrain]] = [(run.plan, run.brain)]
    while left:
        plan, brain = left.pop()
        merged = plan.source.endswith(brain_file(run.out).suffix)  # two brain files, see merge
        drive = brain.sessions.this_drive() if brain.sessions.sessions else set()
        for session in brain.sessions.sessions:
            if session.name in drive and not merged:
                plans.setdefault(session.id, plan)
        for path in map(Path, (plan.source, *plan.maps) if merged else plan.maps):
            if path in asked:
                continue
            asked.add(path)
            try:
                left.append((read_plan(path.parent), load_brain(path)))
            except NeuroslamError:  # moved, or a brain file alone: its source is not known
                continue
    return plans
