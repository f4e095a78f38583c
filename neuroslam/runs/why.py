"""Why a frame of a run closed a loop, or none: each check with its numbers, and the two views.

The run is repeated up to the frame, so the numbers are those of the brain at that instant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import nn

from neuroslam.brain import NavigationBrain, load_brain, read_checkpoint
from neuroslam.brain.tracker import Seen
from neuroslam.config.sequence import SequenceConfig
from neuroslam.errors import BadFrame, RunError, counted
from neuroslam.figures.style import STYLE, as_rgb, new_figure, plain_text, save, write_title
from neuroslam.figures.views import strokes
from neuroslam.geometry import TWO_PI
from neuroslam.mapping.actions import nearest_bound_of_arrays
from neuroslam.runs.files import RunPlan, brain_file
from neuroslam.runs.reading import read_plan
from neuroslam.sensors import open_source
from neuroslam.threads import limit_threads
from neuroslam.types import NO_EXPERIENCE, NO_TEMPLATE, Frame, StepResult

RECENT_S = 5.0
"""An experience that the robot was at within this time is no loop."""


@dataclass(frozen=True)
class Check:
    """One check on the way to a loop closure.

    Attributes:
        name: What is checked.
        value: Its value at this frame; ``None``: it has none.
        limit: Its limit; ``None``: it has none.
        passed: Whether the frame passed.
        unit: Unit of value and limit, and which side of the limit passes.
    """

    name: str
    value: float | None
    limit: float | None
    passed: bool
    unit: str = ""


@dataclass(frozen=True)
class Why:
    """Why a frame closed a loop or not.

    Attributes:
        frame: Number of the frame.
        action: What the brain did: ``create``, ``link``, ``set`` or ``none``.
        closed: Whether it came to an experience that it had not been at for :data:`RECENT_S`.
        verdict: One sentence.
        checks: In the order in which they are made.
        candidate: The template of an earlier place that is most similar to the view; -1: none.
        experience: An experience with that template, the nearest in the pose cells; -1: none.
        stored: For each stored map that is not joined, what was recognised of it.
        picture: Image of the frame; ``None``: it has none.
        view: Template that the frame makes, in [0, 1]; ``None``: none.
        template: The candidate, in [0, 1]; ``None``: none.
        orientations: Of the gradients that views are made of; 0: views are grey.
    """

    frame: int
    action: str
    closed: bool
    verdict: str
    checks: list[Check]
    candidate: int
    experience: int
    stored: list[dict[str, Any]]
    picture: np.ndarray | None
    view: np.ndarray | None
    template: np.ndarray | None
    orientations: int = 0


def why(
    out: str | Path,
    frame: int,
    to: str | Path | None = None,
    *,
    on_step: Callable[[StepResult], None] | None = None,
    features: nn.Module | None = None,
) -> Why:
    """Explain the decision of a run at a frame; draw the two views if ``to`` is given.

    Args:
        out: Folder of the run; its source has to be where it was.
        frame: Number of the frame in the source.
        to: PNG file of the picture.
        on_step: Called after each repeated frame.
        features: The network that computes views, if one was passed to the run.

    Raises:
        RunError: If there is no such run, or the frame was not part of it.
        SourceError: If the source cannot be read.
        CheckpointError: If a brain file cannot be read.
    """
    plan = read_plan(out)
    config = read_checkpoint(brain_file(out))[0]
    brain = NavigationBrain(config, features=features)
    brain.about = (plan.name, "", "")
    for path in plan.maps:
        brain.store(load_brain(path))
    source = open_source(plan.source, config.frame_rate_hz, config.view.grey)
    if frame < plan.start or (plan.stop is not None and frame >= plan.stop):
        raise RunError(f"{out}: the run has no frame {frame}; its frames are {_range(plan)}")
    visited: dict[tuple[int, int], float] = {}
    ignored: list[BadFrame] = []
    skip = ignored.append if plan.skips else None
    with limit_threads(config.threads), torch.inference_mode():
        for one in source.frames(plan.start, frame + 1, skip):
            if one.index == frame:
                found = _explain(brain, one, visited)
                break
            try:
                result = brain(one)
            except BadFrame as fault:
                if skip is None:
                    raise
                skip(fault)
                continue
            _visit(brain, visited)
            if on_step is not None:
                on_step(result)
        else:
            reason = f": {ignored[-1]}" if ignored else ""
            raise RunError(f"{out}: frame {frame} is not in its source or was skipped{reason}")
    if to is not None:
        try:
            save(draw_why(found), Path(to))
        except OSError as error:
            raise RunError(f"{to}: cannot be written ({error.strerror or error})") from None
    return found


def _range(plan: RunPlan) -> str:
    return f"{plan.start} on" if plan.stop is None else f"{plan.start} to {plan.stop - 1}"


def _key(brain: NavigationBrain, experience: int) -> tuple[int, int]:
    """Return what an experience keeps when a merge renumbers it."""
    table = brain.map.experiences
    return int(table["session"][experience]), int(table["number"][experience])


def _tracks(brain: NavigationBrain) -> bool:
    """Return whether the robot is at known places, by sequences of views."""
    return brain.tracker is not None and brain.tracker.tracks


def _visit(brain: NavigationBrain, visited: dict[tuple[int, int], float]) -> None:
    if brain.map.current != NO_EXPERIENCE:
        visited[_key(brain, brain.map.current)] = brain.clock.time_s


def _explain(brain: NavigationBrain, frame: Frame, visited: dict[tuple[int, int], float]) -> Why:
    """Advance by the frame and compare what was before with what it did."""
    config = brain.config
    bound = brain.map.experiences["cell"].numpy().copy()
    templates = brain.map.experiences["template"].numpy().copy()
    since_s = np.array(
        [frame.time_s - visited.get(_key(brain, i), -np.inf) for i in range(brain.map.n)]
    )
    old = since_s > RECENT_S
    view, contrast = None, 0.0
    if frame.image is not None:
        view, contrast = brain.view.encoder(frame.image)
    n_templates, merges = brain.view.n, len(brain.sessions.merges)
    ids = np.unique(templates[old])
    ids = ids[ids != NO_TEMPLATE]
    errors = np.empty(0) if view is None else brain.view.differences(view, np.arange(n_templates))
    candidate = NO_TEMPLATE if view is None or not len(ids) else int(ids[errors[ids].argmin()])
    stored_template = None if candidate == NO_TEMPLATE else brain.view.stored_view(candidate)
    refusals = len(brain.sessions.refusals)
    tracked = _tracks(brain)
    result = brain(frame)
    joined = len(brain.sessions.merges) > merges

    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    turned = result.view.relative_heading_rad * cells.n_theta / TWO_PI
    now = (result.cells.x, result.cells.y, result.cells.theta - turned)
    among = np.where(old, templates, NO_TEMPLATE)
    experience, square = nearest_bound_of_arrays(bound, among, candidate, now, torus)
    if candidate == NO_TEMPLATE:
        experience = NO_EXPERIENCE
    reached = result.experience
    arrived = result.action in ("link", "set") and reached < len(old)
    closed = joined or (arrived and bool(old[reached]))
    contrast = None if view is None else contrast
    checks = _checks(brain, contrast, errors, len(ids), candidate, experience, square, result)
    if joined:
        verdict = "A stored map was recognised and joined at this frame."
    elif tracked and _tracks(brain) and not all(check.passed for check in checks):
        made = int(brain.map.experiences["first_frame"][reached])
        verdict = (
            f"No loop to close: the robot follows the map and is at experience {reached}, made at "
            f"frame {made}. The checks are those of a jump to another part of the map."
        )
    elif closed:
        verdict = f"A loop was closed to experience {reached}: every check passed."
    else:
        verdict = _verdict(checks, result)
    stored = brain.not_joined()
    if len(brain.sessions.refusals) > refusals:
        stored.append({"refused": brain.sessions.refusals[-1].get("reason", "merge refused")})
    return Why(
        frame.index, result.action, closed, verdict, checks, candidate, experience, stored,
        frame.image, view, stored_template, brain.config.view.orientations,
    )  # fmt: skip


def _checks(
    brain: NavigationBrain,
    contrast: float | None,
    errors: np.ndarray,
    n_earlier: int,
    candidate: int,
    experience: int,
    square: float,
    result: StepResult,
) -> list[Check]:
    """List the checks of an earlier place; those after the first that fails are also measured."""
    view, cells = brain.config.view, brain.config.pose_cells
    found = [
        Check(
            "contrast of the image",
            contrast,
            view.min_contrast,
            contrast is not None and contrast >= view.min_contrast,
            "at least",
        ),
        Check(
            f"earlier views, of places not visited for {RECENT_S:g} s",
            float(n_earlier),
            1.0,
            n_earlier >= 1,
            "at least",
        ),
    ]
    if candidate == NO_TEMPLATE:
        return found
    error = float(errors[candidate])
    found += [
        Check("match error", error, view.threshold, error <= view.threshold, "at most"),
        Check(
            "match error, beside the best of all templates",
            error,
            float(errors.min()),
            candidate == int(errors.argmin()),
            "the smallest",
        ),
    ]
    if brain.tracker is not None:
        return [*found[:2], *_checks_of_tracker(brain.tracker.seen, brain.config.sequence)]
    if brain.leader.kind == "pose":
        apart = float(np.sqrt(square)) if experience != NO_EXPERIENCE else None
        found.append(
            Check(
                "distance in the pose cells",
                apart,
                cells.create_threshold_cells,
                apart is not None and apart <= cells.create_threshold_cells,
                "cells, at most",
            )
        )
        found.append(
            Check(
                "no other population contradicts",
                None,
                None,
                result.action != "set",
            )
        )
    return found


def _checks_of_tracker(seen: Seen, limits: SequenceConfig) -> list[Check]:
    """List the checks of a loop closure by a sequence of views, as the tracker made them."""
    above, least = "above", "at least"
    lead = seen.evidence - seen.rival
    none = seen.candidate == NO_EXPERIENCE
    candidate = "an experience" if none else f"experience {seen.candidate}"
    rows: list[tuple[str, float, float, bool, str]] = [
        ("experiences compared", seen.compared, limits.min_experiences,
         seen.compared >= limits.min_experiences, least),
        (f"evidence for {candidate}, standard deviations", seen.evidence, limits.believe,
         seen.evidence > limits.believe, above),
        ("its lead over any other part of the map, standard deviations", lead, limits.margin,
         lead > limits.margin, above),
        ("frames in a row that agree", seen.streak, limits.confirm_frames,
         seen.streak >= limits.confirm_frames, least),
        ("experiences passed meanwhile", seen.passed, limits.confirm_experiences,
         seen.passed >= limits.confirm_experiences, least),
        ("match error, as a share of the usual one", seen.alike, limits.alike,
         seen.alike <= limits.alike, "at most"),
    ]  # fmt: skip
    return [
        Check(name, float(value), float(limit), passed, unit)
        for name, value, limit, passed, unit in rows
    ]


def _verdict(checks: list[Check], result: StepResult) -> str:
    """Name the first check that failed."""
    failed = next((check for check in checks if not check.passed), None)
    if failed is None:
        return (
            f"Every check passed, but the cells decided otherwise: action {result.action!r} at "
            f"experience {result.experience}."
        )
    if failed.value is None or failed.limit is None:
        return f"No loop: stopped by {failed.name!r}."
    return (
        f"No loop: stopped by {failed.name!r}, {failed.value:.4g}; expected {failed.unit} "
        f"{failed.limit:.4g}."
    )


def draw_why(found: Why) -> Figure:
    """Draw the image of the frame, the view that it makes, and the template of the earlier place.

    Args:
        found: Result of :func:`why`.
    """
    panels = [
        (f"frame {found.frame}", found.picture),
        ("its view", found.view),
        (f"template {found.candidate} of an earlier place", found.template),
    ]
    with mpl.rc_context(STYLE):
        figure = new_figure(9.6, 3.1, None)
        figure.suptitle(plain_text(found.verdict), fontsize=9)
        for axes, (name, image) in zip(figure.subplots(1, 3), panels, strict=True):
            axes.set_axis_off()
            write_title(axes, name if image is not None else f"{name.split(' of')[0]}: none")
            if image is not None and image.dtype == np.uint8:
                axes.imshow(as_rgb(image))
            elif image is not None and found.orientations:
                drawn = strokes(np.round(255.0 * image).astype(np.uint8), found.orientations)
                axes.imshow(drawn, cmap="gray", vmin=0, vmax=255)
            elif image is not None:
                axes.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, aspect="auto")
    return figure


def summary_rows(found: Why) -> list[tuple[str, str, str, str]]:
    """Return check, value, limit and whether it passed, as text, for a table."""
    return [
        (
            check.name,
            "" if check.value is None else f"{check.value:.4g}",
            "" if check.limit is None else f"{check.unit} {check.limit:.4g}",
            "yes" if check.passed else "no",
        )
        for check in found.checks
    ]


def stored_lines(found: Why) -> list[str]:
    """Return a line for each stored map that is not joined."""
    return [
        f"Stored map: {row['refused']}"
        if "refused" in row
        else f"Stored map of {counted(int(row['experiences']), 'experience')}: {row['reason']}"
        for row in found.stored
    ]
