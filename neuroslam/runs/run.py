"""A run: a brain maps a source, and the files of the run are written meanwhile."""

import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.config import (
    BrainConfig,
    build_config,
    merge_values,
    parse_assignment,
    read_config_file,
    read_preset,
)
from neuroslam.errors import BadFrame, ConfigError, MapError, RunError, SourceError, counted
from neuroslam.interrupts import noting_interrupts
from neuroslam.runs.activity import ActivityRecorder, Recorders
from neuroslam.runs.clocks import resolve_offset
from neuroslam.runs.files import (
    OnBadFrame,
    RowWriter,
    RunPlan,
    brain_file,
    more_columns,
    require_free,
    run_files,
)
from neuroslam.runs.reading import read_plan
from neuroslam.runs.recording import NullRecorder, Recorder, TensorBoardRecorder
from neuroslam.runs.results import RunSaver, RunSummary, read_summary, write_results
from neuroslam.runs.saves import writing
from neuroslam.runs.truth import WithTruth
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.axes import parse_axes
from neuroslam.sensors.landmarks import LandmarkWords, read_landmarks
from neuroslam.sensors.open import absolute_spec
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.state.activity import ACTIVITY, DEFAULT_RATE_HZ
from neuroslam.state.activity_writer import ActivityWriter
from neuroslam.threads import limit_threads, usable_threads
from neuroslam.types import Frame, StepResult

if TYPE_CHECKING:
    from neuroslam.runs.live_map import LiveRecorder

SAVE_EVERY_S = 60.0
"""Wall-clock seconds between two saves: what a killed run can lose."""


def resolve_config(
    preset: str | None = None,
    config: Path | None = None,
    assignments: tuple[str, ...] = (),
    base: BrainConfig | None = None,
    *,
    option: str = "--set",
    estimated: Mapping[str, Any] | None = None,
) -> BrainConfig:
    """Build a config from a preset, a config file and assignments; the later ones override.

    Args:
        preset: Name of a preset.
        config: TOML file, or an OpenRatSLAM file.
        assignments: Assignments like ``view.threshold=0.04``.
        base: Config to start from if there is neither preset nor file, e.g. that of a stored map;
            default: the default config.
        option: Command-line option of the assignments, for messages.
        estimated: Sections and keys estimated from the source; they override the preset alone.

    Raises:
        ConfigError: If a preset, file, key or value is invalid.

    Example:
        >>> resolve_config(assignments=("view.threshold=0.04",)).view.threshold
        0.04
    """
    values = read_preset(preset) if preset else {}
    origin = f"preset {preset}" if preset else "config"
    if base is not None and not preset and config is None:
        values = base.model_dump(exclude_none=True)
    if estimated:
        values = merge_values(values, dict(estimated))
    if config is not None:
        from_file = read_config_file(config)
        from_file.pop("run", None)  # table of the config.toml of a run
        values, origin = merge_values(values, from_file), f"config {config}"
    for text in assignments:
        values = merge_values(values, parse_assignment(text))
    if assignments:
        origin = option if not config else f"{origin} with {option}"
    return _with_absolute_weights(build_config(values, origin))


def run(
    source: str | Path,
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    maps: Sequence[str | Path] = (),
    landmarks: str | Path | None = None,
    truth: str | Path | None = None,
    axes: str | None = None,
    offset: str | float | None = None,
    preset: str = "",
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    tensorboard: bool = True,
    mcap: str | Path | None = None,
    rerun: bool = False,
    rerun_save: str | Path | None = None,
    overwrite: bool = False,
    on_step: Callable[[StepResult], None] | None = None,
    on_start: Callable[[int | None], None] | None = None,
    features: nn.Module | None = None,
    save_every_s: float = SAVE_EVERY_S,
    record: bool | Sequence[str] = False,
    record_rate_hz: float = DEFAULT_RATE_HZ,
    live: str | Path | None = None,
    robot: str = "",
) -> RunSummary:
    """Map a source and write the files of the run into a folder.

    Args:
        source: Source that :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write; created if missing.
        config: Config of the brain; default: that of the first of ``maps``, or the default config.
        maps: Stored maps, as run folders or brain files; each is joined once it is recognised.
        landmarks: File of names and attributes of landmarks, of walls and regions, see
            :func:`~neuroslam.sensors.landmarks.read_landmarks`; they replace those that the source
            has. They are stored in the brain.
        truth: File of true positions, see :func:`~neuroslam.runs.truth.read_truth`, for figures and
            errors; the brain never sees it. It replaces what the source knows.
        axes: Axes of the ground plane in ``truth``, see
            :func:`~neuroslam.sensors.axes.parse_axes`; default: x and y.
        offset: Seconds to add to the times of the motion of a source ``VIDEO+MOTION.csv``; ``auto``
            finds them by the turn rates, see :func:`~neuroslam.runs.clocks.resolve_offset`.
        preset: Name of the preset of the config, stored with the session.
        start: First frame of the source.
        stop: Frame to stop before; default: the end.
        on_bad_frame: ``stop`` at an unusable frame, or ``skip`` and count it.
        tensorboard: Write ``events/`` too.
        mcap: File to write for Foxglove, see :mod:`neuroslam.runs.mcap`; extra ``mcap``.
        rerun: Open the viewer of rerun, see :mod:`neuroslam.runs.rerun`; extra ``rerun``.
        rerun_save: File to write for rerun (``.rrd``).
        overwrite: Replace the files of an earlier run in ``out``.
        on_step: Called after each frame with its result.
        on_start: Called once with the frame to stop before; ``None``: unknown.
        features: Network that computes views, if ``config.view.features`` is ``"module"``.
        save_every_s: Wall-clock seconds between two saves of the brain, from which a killed run can
            be resumed; 0: only at the end.
        record: Write the activity of all cells, or of these populations, into ``activity.zarr``,
            which :meth:`~neuroslam.state.activity.ActivityLog.open` reads.
        record_rate_hz: Samples of it a second.
        live: Shared map to which the robot offers its places meanwhile, a folder or ``ray:NAME``;
            see :mod:`neuroslam.runs.live_map`.
        robot: Name of the robot there; default: its session.

    Returns:
        Summary of the run. A bad frame under ``stop`` ends the run; its files are still written,
        and ``failure`` holds the error.

    Raises:
        SourceError: If the source cannot be opened, or the words of landmarks or the truth cannot
            be read.
        CheckpointError: If a stored map cannot be loaded.
        ConfigError: If a stored map was made with another config.
        RunError: If the range holds no usable frame, or there are words and no semantic map; or if
            ``out`` holds a run already and ``overwrite`` is off, or cannot be written.
    """
    out = Path(out)
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    paths = tuple(_absolute(brain_file(path)) for path in maps)
    true_file = "" if truth is None else str(Path(truth).resolve())
    if axes is not None:
        if truth is None:
            raise RunError(f"--axes {axes}: are those of a file of truth; give --truth FILE too")
        parse_axes(axes)
    plan = RunPlan(_absolute(source), start, stop, on_bad_frame, paths, true_file, axes or "")
    require_free(out, plan.source, overwrite)
    if any(Path(path).parent == out.resolve() for path in paths):
        raise RunError(
            f"{out}: holds the stored map, which would be overwritten; choose another folder"
        )
    words = () if landmarks is None else read_landmarks(landmarks)
    stored = [load_brain(path) for path in paths]  # first: nothing is written if this fails
    config = _with_absolute_weights(config or (stored[0].config if stored else BrainConfig()))
    source, found = resolve_offset(str(source), offset, config)
    plan = replace(plan, source=_absolute(source))
    opened = _opened(source, plan, config)
    if opened.n_frames is not None and start >= opened.n_frames:
        raise RunError(
            f"{source}: has {counted(opened.n_frames, 'frame')}, none from --start {start} on"
        )
    brain = NavigationBrain(config, features=features)
    summary = RunSummary(notes=[*found, *opened.notes])
    brain.about = (plan.name, preset, recorded(plan.source))
    _name_landmarks(brain, opened, words)
    for one in stored:
        brain.store(one)
    shared = _shared(live, robot, brain, maps)
    _announce(on_start, stop, opened)
    with (
        limit_threads(usable_threads(brain.config.threads)),
        torch.inference_mode(),
        noting_interrupts() as interrupts,
    ):
        steps = _steps(brain, opened, plan, summary)
        first = next(steps, None)  # an earlier run is kept if this fails
        if first is None:
            raise RunError(f"{source}: no usable frame{_and_why(summary.skipped)}")
        with writing(out) as folder:
            require_free(out, plan.source, overwrite)  # another process may have been faster
            earlier = any((out / name).exists() for name in run_files(out))
            save = RunSaver(folder, folder.staged if earlier else out)
            with RowWriter.create(save.rows_in, more_columns(brain)) as output:
                writer = None
                if record:
                    only = None if isinstance(record, bool) else record
                    about = {"source": plan.source, "cells": list(config.cells)}
                    log_in = _emptied(save.rows_in / ACTIVITY)
                    writer = ActivityWriter(log_in, record_rate_hz, only, about)
                recorder = _recorder(save, tensorboard, writer)
                if mcap is not None:
                    from neuroslam.runs.mcap import McapRecorder

                    recorder = Recorders([recorder, McapRecorder(Path(mcap))])
                if rerun or rerun_save is not None:
                    from neuroslam.runs.rerun import RerunRecorder

                    file = None if rerun_save is None else Path(rerun_save)
                    recorder = Recorders([recorder, RerunRecorder(file, rerun)])
                if shared is not None:
                    recorder = Recorders([recorder, shared])
                due = _saver(brain, plan, save, summary, output, recorder, save_every_s)
                steps = chain([first], steps)
                _drive(brain, steps, output, recorder, summary, on_step, interrupts, due)
                _end(brain, plan, summary)
                _note_source(summary, opened)
                if shared is not None:
                    summary.notes.append(shared.note())
                return write_results(brain, plan, save, summary)


def _shared(
    live: str | Path | None, robot: str, brain: NavigationBrain, maps: Sequence[str | Path]
) -> "LiveRecorder | None":
    """Open the shared map of a run; before anything is written, as its config may differ."""
    if live is None:
        return None
    if maps:
        raise ConfigError(
            "a robot of a shared map maps by itself: leave --map out; neuroslam localise finds it "
            "on a map"
        )
    from neuroslam.runs.live_map import LiveRecorder

    return LiveRecorder(live, brain, robot)


def _opened(source: str | Path, plan: RunPlan, config: BrainConfig) -> Source:
    """Open the source of a run, with the truth of its file, if it has one."""
    opened = open_source(source, config.frame_rate_hz, config.view.grey)
    return WithTruth(opened, plan.truth, plan.axes or None) if plan.truth else opened


def _name_landmarks(
    brain: NavigationBrain, source: Source, words: tuple[LandmarkWords, ...]
) -> None:
    """Give the semantic map of a brain the words of the source, then those of a file."""
    cells = brain.populations.get("semantic")
    if isinstance(cells, SemanticCells):
        for table in (source.landmark_words, words):
            if table:
                cells.name_landmarks(table)
    elif words:
        raise RunError(
            f"--landmarks: the brain has no semantic map, its cells are "
            f"{'+'.join(brain.config.cells)}; add semantic to them"
        )


def resume(
    out: str | Path,
    *,
    stop: int | None = None,
    tensorboard: bool = True,
    on_step: Callable[[StepResult], None] | None = None,
    on_start: Callable[[int | None], None] | None = None,
    features: nn.Module | None = None,
    save_every_s: float = SAVE_EVERY_S,
) -> RunSummary:
    """Resume a run; its files become equal to those of an uninterrupted run.

    Args:
        out: Folder of the run.
        stop: Frame to stop before; default: the end of the source.
        tensorboard: Append to ``events/`` too.
        on_step: Called after each frame.
        on_start: As for :func:`run`.
        features: The network that computes views, if one was passed to the run.
        save_every_s: As for :func:`run`.

    Raises:
        RunError: If the folder holds no run, files are missing, or the run is past ``stop``.
        CheckpointError: If its brain cannot be loaded.
    """
    out = Path(out)
    if not out.is_dir():
        read_plan(out)  # says what is there instead
    with writing(out) as folder:
        plan = replace(read_plan(out), stop=stop)
        brain = load_brain(brain_file(out), features=features)
        seen, first = brain.clock.frames_seen, brain.clock.frame + 1
        if stop is not None and stop < first:
            raise RunError(
                f"{out}: is at frame {first}; expected --stop of at least that, got {stop}"
            )
        opened = _opened(plan.source, plan, brain.config)
        summary = read_summary(out)
        _announce(on_start, stop, opened)
        onward = replace(plan, start=max(first, plan.start))
        save = RunSaver(folder, out)
        with (
            limit_threads(usable_threads(brain.config.threads)),
            torch.inference_mode(),
            noting_interrupts() as interrupts,
            RowWriter.reopen(out, seen) as output,
        ):
            steps = _steps(brain, opened, onward, summary)
            writer = None
            if (out / ACTIVITY).is_dir():
                writer = ActivityWriter.reopen(out / ACTIVITY, brain.clock.frame)
            recorder = _recorder(save, tensorboard, writer)
            due = _saver(brain, plan, save, summary, output, recorder, save_every_s)
            _drive(brain, steps, output, recorder, summary, on_step, interrupts, due)
            _end(brain, plan, summary)
            _note_source(summary, opened)
            return write_results(brain, plan, save, summary)


def _recorder(save: RunSaver, tensorboard: bool, activity: ActivityWriter | None) -> Recorder:
    events = TensorBoardRecorder(save.rows_in / "events") if tensorboard else NullRecorder()
    return events if activity is None else Recorders([events, ActivityRecorder(activity)])


def _emptied(folder: Path) -> Path:
    """Return a folder from which what an earlier run left behind is removed."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _note_source(summary: RunSummary, source: Source) -> None:
    """Note what was found out about a source while it was read."""
    summary.unused = list(source.unused)
    summary.notes += [note for note in source.notes if note not in summary.notes]


def _announce(
    on_start: Callable[[int | None], None] | None, stop: int | None, source: Source
) -> None:
    if on_start is not None:
        on_start(min((n for n in (stop, source.n_frames) if n is not None), default=None))


def _steps(
    brain: NavigationBrain, source: Source, plan: RunPlan, summary: RunSummary
) -> Iterator[tuple[Frame, StepResult]]:
    """Yield each frame with its result; skipped frames are noted in the summary."""
    skip = (lambda fault: summary.skipped.append(str(fault))) if plan.skips else None
    for frame in source.frames(plan.start, plan.stop, skip):
        try:
            result = brain(frame)
        except BadFrame as error:
            if skip is None:
                raise
            skip(error)
        else:
            summary.pictures |= frame.image is not None
            measured = frame.velocity is not None and brain.config.odometry.use != "visual"
            summary.measured = bool(summary.measured) or measured
            yield frame, result


def _drive(
    brain: NavigationBrain,
    steps: Iterable[tuple[Frame, StepResult]],
    output: RowWriter,
    recorder: Recorder,
    summary: RunSummary,
    on_step: Callable[[StepResult], None] | None,
    interrupts: list[int],
    save: Callable[[], None],
) -> None:
    wall = time.perf_counter() - summary.seconds  # a resumed run counts on
    cpu = time.process_time() - summary.cpu_seconds

    def note_time() -> None:
        summary.seconds = time.perf_counter() - wall
        summary.cpu_seconds = time.process_time() - cpu

    try:
        with recorder:
            for frame, result in steps:
                output.write(result, frame, brain)
                recorder.step(result, frame, brain)
                summary.added += 1
                if on_step is not None:
                    on_step(result)
                note_time()
                save()
                if interrupts:
                    break
    except (SourceError, MapError) as error:
        if brain.half_taken:  # no state to write: what was saved before is kept
            raise RunError(f"{error}; the map is not written: {brain.half_taken}") from error
        summary.failure, summary.bad_frame = str(error), isinstance(error, BadFrame)
    summary.interrupted = bool(interrupts)
    # A resumed run reads the bad frames after its last good one again: count them once.
    summary.skipped = list(dict.fromkeys(summary.skipped))
    note_time()


def _end(brain: NavigationBrain, plan: RunPlan, summary: RunSummary) -> None:
    """Solve the whole map once its source has ended; a run that can go on stays as it is."""
    if summary.added and plan.stop is None and not (summary.interrupted or summary.failure):
        brain.map.solve()


def _saver(
    brain: NavigationBrain,
    plan: RunPlan,
    save: RunSaver,
    summary: RunSummary,
    output: RowWriter,
    recorder: Recorder,
    every_s: float,
) -> Callable[[], None]:
    """Return a function that saves the run in progress when a save is due."""
    saved = time.monotonic()
    save.rows = output.saved  # every frame that the brain has seen needs its row

    def save_if_due() -> None:
        nonlocal saved
        if every_s and time.monotonic() - saved >= every_s:
            so_far = replace(summary, frames=brain.clock.frames_seen, interrupted=True)
            with recorder.moving_to(save.folder.out / "events"):
                save(brain, plan, so_far)
            saved = time.monotonic()

    return save_if_due


def _and_why(skipped: list[str]) -> str:
    return (
        f"; {counted(len(skipped), 'was', 'were')} skipped, the first: {skipped[0]}"
        if skipped
        else ""
    )


def _with_absolute_weights(config: BrainConfig) -> BrainConfig:
    """Make the path of network weights absolute: a run can be resumed from another folder."""
    if config.view.weights is None:
        return config
    view = config.view.model_copy(update={"weights": str(Path(config.view.weights).resolve())})
    return config.model_copy(update={"view": view})


def _absolute(source: str | Path) -> str:
    text = str(source)
    try:
        text.encode()
    except UnicodeEncodeError:
        raise SourceError(f"{text!a}: its name is not UTF-8; rename it") from None
    return absolute_spec(text)


def recorded(source: str) -> str:
    """Return the date of a recording's file (UTC, ISO); empty if the source is no file."""
    path = Path(source)
    if not path.exists():  # rendered, or two recordings
        return ""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat()
