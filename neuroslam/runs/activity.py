"""Recording of all cells: during a run, and in Python."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuroslam.config import BrainConfig, build_config, read_preset
from neuroslam.errors import ConfigError, RunError
from neuroslam.runs.recording import Recorder
from neuroslam.sensors import Source, open_source
from neuroslam.state.activity import ACTIVITY, DEFAULT_RATE_HZ, ActivityLog
from neuroslam.state.activity_writer import ActivityWriter
from neuroslam.types import Frame, StepResult

if TYPE_CHECKING:
    from neuroslam.brain.brain import NavigationBrain


class ActivityRecorder(Recorder):
    """Records the activity of a run's cells.

    Args:
        writer: The :class:`~neuroslam.state.activity_writer.ActivityWriter` of the log.
    """

    def __init__(self, writer: ActivityWriter) -> None:
        self.writer = writer
        self._brain: NavigationBrain | None = None

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Take a sample, if one is due."""
        self._brain = brain
        self.writer.note(result, frame, brain.populations)

    @contextlib.contextmanager
    def moving_to(self, folder: Path) -> Iterator[None]:
        """Write all samples, let the block move the files, and write on beside ``folder``."""
        self._write()
        yield
        self.writer.moved(folder.parent / ACTIVITY)

    def close(self) -> None:
        """Write the last samples, and what the cells are tuned to."""
        self._write()

    def _write(self) -> None:
        self.writer.flush()
        if self._brain is not None:
            self.writer.describe(self._brain.populations)


class Recorders(Recorder):
    """Several recorders of one run."""

    def __init__(self, parts: Sequence[Recorder]) -> None:
        self.parts = parts

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Let each record the frame."""
        for part in self.parts:
            part.step(result, frame, brain)

    @contextlib.contextmanager
    def moving_to(self, folder: Path) -> Iterator[None]:
        """Let the block move the files of all."""
        with contextlib.ExitStack() as stack:
            for part in self.parts:
                stack.enter_context(part.moving_to(folder))
            yield

    def close(self) -> None:
        """Close each."""
        for part in self.parts:
            part.close()


def parse_record(text: str) -> tuple[str, ...] | None:
    """Return the populations that ``--record`` names; ``None``: all.

    Raises:
        RunError: If it is not ``cells`` or ``cells=NAME,...``.

    Example:
        >>> parse_record("cells"), parse_record("cells=grid,place")
        (None, ('grid', 'place'))
    """
    what, named, names = text.partition("=")
    chosen = tuple(name.strip() for name in names.split(",") if name.strip())
    if what != "cells" or (named and not chosen):
        raise RunError(f"--record {text}: expected cells, or cells=POPULATION,..., as cells=grid")
    return chosen or None


def record(
    source: "str | Path | Source | Iterable[Frame]",
    brain: "NavigationBrain | BrainConfig | str" = "slrb",
    *,
    rate_hz: float = DEFAULT_RATE_HZ,
    only: Iterable[str] | None = None,
    out: str | Path | None = None,
) -> ActivityLog:
    """Drive a brain along a source, and return the activity of all its cells.

    Args:
        source: A source, or its name for :func:`neuroslam.sensors.open_source`; or any frames.
        brain: A preset, a config, or a brain, which continues from the state that it has.
        rate_hz: Samples a second of the source's time, at most one a frame.
        only: Populations to record, as ``("grid", "place")``; ``None``: all.
        out: Folder to record into, for what does not fit into memory; ``None``: memory.

    Raises:
        SourceError, BadFrame: If the source cannot be opened, or a frame of it be used.
        ConfigError: If the preset, or a population to record, does not exist; or ``out`` does.

    Example:
        >>> log = record("arena:square?minutes=0.1", only=["grid"])
        >>> log["grid"].shape, log.position_m.shape
        ((121, 96), (121, 2))
    """
    from neuroslam.brain.brain import NavigationBrain

    if isinstance(brain, str):
        brain = build_config(read_preset(brain), f"preset {brain}")
    if isinstance(brain, BrainConfig):
        brain = NavigationBrain(brain)
    about: dict[str, object] = {"cells": list(brain.config.cells)}
    if isinstance(source, str | Path):
        about["source"] = str(source)
        source = open_source(source, brain.config.frame_rate_hz, brain.config.view.grey)
    else:
        about["source"] = str(getattr(source, "name", "frames"))
    path = None if out is None else Path(out)
    if path is not None and path.exists() and any(path.iterdir()):
        raise ConfigError(f"{path}: is not empty; choose another folder to record into")
    writer = ActivityWriter(path, rate_hz, only, about)
    for frame in source:
        writer.note(brain(frame), frame, brain.populations)
    writer.flush()
    writer.describe(brain.populations)
    return writer.log()
