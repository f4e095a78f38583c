"""Reading and checking the folder of a finished run."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import NeuroslamError, RunError
from neuroslam.runs.files import RunPlan, brain_file
from neuroslam.runs.reading import (
    frame_rows,
    read_actions,
    read_frames,
    read_metrics,
    read_plan,
    read_planned,
    read_trace,
)

CURVES = ("cells/peak", "cells/doubt_s", "map/largest_correction")
"""Scalars of ``events/`` that no other file of a run has."""


class Curve(NamedTuple):
    """A scalar over a run: rows of ``frames.csv`` and the values, arrays of equal length."""

    rows: np.ndarray
    values: np.ndarray


class FinishedRun(NamedTuple):
    """The files of a run; ``frames`` and ``trace`` have a row per frame, or none after a merge.

    ``planned`` are the experiences of the path in ``plan.csv``.
    """

    out: Path
    plan: RunPlan
    brain: NavigationBrain
    frames: dict[str, np.ndarray]
    actions: np.ndarray
    trace: dict[str, np.ndarray]
    metrics: dict[str, Any]
    curves: dict[str, Curve]
    planned: list[int]


def read_run(out: str | Path) -> FinishedRun:
    """Read the folder that ``run``, ``resume`` or ``merge`` wrote.

    Rows that a killed run wrote after its last checkpoint are ignored.

    Raises:
        RunError: If the folder holds no run, or a file of it is missing or damaged.
        CheckpointError: If its brain cannot be loaded.
    """
    out = Path(out)
    if not out.is_dir():
        what = "is a file" if out.exists() else "no such folder"
        raise RunError(f"{out}: {what}; expected the folder of a run")
    plan, brain = read_plan(out), load_brain(brain_file(out))
    rows = brain.clock.frames_seen
    if brain.sessions.merges and not frame_rows(out, 1):
        rows = 0  # a merge of two brain files, without frames
    frames, actions = read_frames(out, rows), read_actions(out, rows)
    trace = read_trace(out, rows or None, min_rows=0)
    return FinishedRun(
        out,
        plan,
        brain.largest,
        frames,
        actions,
        {name: column[:rows] for name, column in trace.items()},
        read_metrics(out),
        read_curves(out, frames["frame"]),
        read_planned(out),
    )


def read_curves(out: Path, frames: np.ndarray) -> dict[str, Curve]:
    """Read those of ``CURVES`` that the TensorBoard events of a run have.

    Args:
        out: Folder of the run.
        frames: Number of the frame of each row, rising.
    """
    files = sorted((out / "events").glob("events.out.tfevents.*"))
    if not files or not len(frames):
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations in tensorboard's imports
        from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
    found: dict[str, dict[int, float]] = {name: {} for name in CURVES}
    for file in files:
        for event in EventFileLoader(str(file)).Load():
            for value in event.summary.value:
                if value.tag in found:  # a resumed run may repeat a frame: the later value counts
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


def session_plans(run: FinishedRun, others: bool = True) -> dict[int, RunPlan]:
    """Find the plan of the run of each session of a map, as far as their folders exist.

    The folder of a run names its source and the stored maps that it joined; their folders in turn
    name their sources.

    Args:
        run: The run.
        others: Read the folders of stored maps too.

    Returns:
        Session id -> plan of the run that made it.
    """
    plans: dict[int, RunPlan] = {}
    visited: set[Path] = set()
    pending: list[tuple[RunPlan, NavigationBrain]] = [(run.plan, run.brain)]
    while pending:
        plan, brain = pending.pop()
        merged = plan.source.endswith(brain_file(run.out).suffix)  # two brain files, see merge
        drive = brain.sessions.this_drive() if brain.sessions.sessions else set()
        for session in brain.sessions.sessions:
            if session.name in drive and not merged:
                plans.setdefault(session.id, plan)
        if not others:
            break
        for path in map(Path, (plan.source, *plan.maps) if merged else plan.maps):
            if path in visited:
                continue
            visited.add(path)
            try:
                pending.append((read_plan(path.parent), load_brain(path)))
            except NeuroslamError:  # moved, or a brain file without its run: source unknown
                continue
    return plans
