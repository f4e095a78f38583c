"""Localise a source in a stored map: a pose and a confidence for every frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from neuroslam.brain import load_brain
from neuroslam.brain.localise import Localisation, Localiser
from neuroslam.errors import BadFrame, RunError
from neuroslam.runs.files import OnBadFrame, brain_file, write_text
from neuroslam.sensors import open_source
from neuroslam.threads import limit_threads

COLUMNS = "frame,time_s,found,x_m,y_m,theta_rad,confidence,experience,match_error,runner_up_ratio"


@dataclass
class LocaliseSummary:
    """What :func:`localise` found.

    Attributes:
        frames: Frames localised or not.
        found: How many of them have a pose.
        first_found: First frame with a pose; ``None``: there is none.
        lost: How often the pose was lost again.
        skipped: Why frames were skipped.
    """

    frames: int = 0
    found: int = 0
    first_found: int | None = None
    lost: int = 0
    skipped: list[str] = field(default_factory=list)


def localise(
    map_path: str | Path,
    source: str | Path,
    out: str | Path,
    *,
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    overwrite: bool = False,
    on_step: Callable[[Localisation], None] | None = None,
    features: nn.Module | None = None,
) -> LocaliseSummary:
    """Localise a source in a stored map, which is not changed; write a row for every frame.

    Args:
        map_path: Folder of a run, or its brain file.
        source: Source that :func:`neuroslam.sensors.open_source` opens.
        out: CSV file to write.
        start: First frame of the source.
        stop: Frame to stop before; default: the end.
        on_bad_frame: ``stop`` at an unusable frame, or ``skip`` and count it.
        overwrite: Replace an earlier file.
        on_step: Called after each frame.
        features: The network that computes views, if one was passed to the run.

    Raises:
        CheckpointError: If the map cannot be loaded.
        MapError: If the map has no views.
        SourceError: If the source cannot be opened or read.
        BadFrame: If a frame is unusable under ``stop``; nothing is written then.
        RunError: If the file exists or cannot be written, or no frame is in the range.
    """
    out, path = Path(out), brain_file(map_path)
    if out.is_dir():
        raise RunError(f"{out}: is a folder; expected the name of a CSV file")
    if out.exists() and (not overwrite or out.resolve() == path.resolve()):
        raise RunError(f"{out}: exists; choose another name or use --overwrite")
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    brain = load_brain(path, features=features).largest
    localiser, summary = Localiser(brain), LocaliseSummary()
    opened = open_source(source, brain.config.frame_rate_hz, brain.config.view.grey)

    def skip(fault: BadFrame) -> None:
        summary.skipped.append(str(fault))

    lines, before = [COLUMNS], False
    with limit_threads(brain.config.threads), torch.inference_mode():
        for frame in opened.frames(start, stop, skip if on_bad_frame == "skip" else None):
            try:
                here = localiser(frame)
            except BadFrame as fault:
                if on_bad_frame == "stop":
                    raise BadFrame(f"frame {frame.index}: {fault}") from None
                skip(fault)
                continue
            found = here.pose is not None
            summary.frames += 1
            summary.found += found
            summary.lost += before and not found
            if found and summary.first_found is None:
                summary.first_found = here.frame
            before = found
            lines.append(_row(here))
            if on_step is not None:
                on_step(here)
    if not summary.frames:
        raise RunError(f"{source}: no usable frame from --start {start} on")
    try:
        write_text(out, "\n".join(lines) + "\n")
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return summary


def _row(here: Localisation) -> str:
    pose = here.pose or ("nan", "nan", "nan")
    figures = (float(here.confidence), here.experience, float(here.error), float(here.ratio))
    values = (here.frame, float(here.time_s), int(here.pose is not None), *pose, *figures)
    return ",".join(value if isinstance(value, str) else repr(value) for value in values)
