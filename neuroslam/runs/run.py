"""A run: a source goes through a brain, and its files are written as it goes."""

import contextlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import (
    BrainConfig,
    build_config,
    merge_values,
    parse_assignment,
    read_config_file,
    read_preset,
    to_toml,
)
from neuroslam.errors import BadFrame, MapError, RunError, SourceError, counted
from neuroslam.evaluation.trajectory import Track, absolute_trajectory_error, write_tum
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import (
    LANDMARKS_FILE,
    OnBadFrame,
    RowWriter,
    RunPlan,
    brain_file,
    experiences_csv,
    landmarks_csv,
    links_csv,
    odometry_track,
    read_metrics,
    read_plan,
    read_trace,
    require_free,
    trajectory,
    true_poses,
    write_text,
)
from neuroslam.runs.parallel import one_thread
from neuroslam.runs.recording import NullRecorder, Recorder, TensorBoardRecorder
from neuroslam.runs.review import draw_map
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.open import absolute_spec
from neuroslam.types import Frame, StepResult

SAVE_EVERY_S = 60.0
"""Of the clock on the wall; what a killed run may lose."""


@dataclass
class RunSummary:
    """What a run did: the content of ``metrics.json``, and how many frames it took in just now."""

    frames: int = 0
    added: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    skipped: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    pictures: bool = False
    interrupted: bool = False
    counts: dict[str, float] = field(default_factory=dict)
    accuracy: dict[str, float] = field(default_factory=dict)
    merges: list[dict[str, Any]] = field(default_factory=list)
    refusals: list[dict[str, Any]] = field(default_factory=list)
    not_joined: list[dict[str, Any]] = field(default_factory=list)
    unplaced: int = 0
    failure: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Name every figure with its unit."""
        return {
            "frames": self.frames,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "frames_per_s": self.frames / self.seconds if self.seconds else 0.0,
            "frames_per_cpu_s": self.frames / self.cpu_seconds if self.cpu_seconds else 0.0,
            **self.counts,
            "merges": len(self.merges),
            "merge_reports": self.merges,
            "refused_merges": self.refusals,
            "not_joined": self.not_joined,
            "frames_on_no_joined_map": self.unplaced,
            "skipped_frames": len(self.skipped),
            "skipped": self.skipped,
            "unused": self.unused,
            "pictures": self.pictures,
            "interrupted": self.interrupted,
            **self.accuracy,
        }


def resolve_config(
    preset: str | None = None,
    config: Path | None = None,
    assignments: tuple[str, ...] = (),
    base: BrainConfig | None = None,
    *,
    option: str = "--set",
) -> BrainConfig:
    """Lay a config file over a preset, and single assignments over both.

    Args:
        preset: Its name.
        config: Our TOML, or an OpenRatSLAM file.
        assignments: Texts like ``view.threshold=0.04``.
        base: What all is laid over where there is neither preset nor file, as a stored map's
            config; the defaults if not given.
        option: What the user wrote the assignments with, for messages.

    Raises:
        ConfigError: If a preset, file, key or value cannot be used.

    Example:
        >>> resolve_config(assignments=("view.threshold=0.04",)).view.threshold
        0.04
    """
    values = read_preset(preset) if preset else {}
    origin = f"preset {preset}" if preset else "config"
    if base is not None and not preset and config is None:
        values = base.model_dump(exclude_none=True)
    if config is not None:
        from_file = read_config_file(config)
        from_file.pop("run", None)  # the table that config.toml of a run has besides
        values, origin = merge_values(values, from_file), f"config {config}"
    for text in assignments:
        values = merge_values(values, parse_assignment(text))
    if assignments:
        origin = option if not config else f"{origin} with {option}"
    return _located(build_config(values, origin))


def run(
    source: str | Path,
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    maps: Sequence[str | Path] = (),
    preset: str = "",
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    tensorboard: bool = True,
    overwrite: bool = False,
    on_step: Callable[[StepResult], None] | None = None,
    on_start: Callable[[int | None], None] | None = None,
    features: nn.Module | None = None,
    save_every_s: float = SAVE_EVERY_S,
) -> RunSummary:
    """Map a source and write the run's files into a folder.

    Args:
        source: Anything :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write; made if missing.
        config: Of the brain; that of the first of ``maps``, or the defaults, if not given.
        maps: Stored maps, as run folders or brain files: each is joined when it is recognised.
        preset: Name of the preset that the config is from, to be remembered.
        start: First frame of the source.
        stop: Frame to stop before; the end if not given.
        on_bad_frame: ``stop`` at a frame that cannot be used, or ``skip`` and count it.
        tensorboard: Write ``events/`` too.
        overwrite: Replace the files of an earlier run in ``out``.
        on_step: Called after each frame, e.g. to show progress.
        on_start: Called once, with the number of the frame to stop before; ``None``: unknown.
        features: Network that makes views, where ``config.view.features`` is ``"module"``.
        save_every_s: Seconds after which the brain is saved while it drives, so that a run which
            is killed can be resumed from there; 0: only at the end.

    Returns:
        What was done; a bad frame under ``stop`` ends the run, whose files are still written,
        with ``failure`` saying what it was.

    Raises:
        SourceError: If the source cannot be opened, or has no frame in the range.
        CheckpointError: If a stored map cannot be loaded.
        ConfigError: If a stored map was made with another config.
        RunError: If ``out`` holds a run already and ``overwrite`` is off, or cannot be written.
    """
    out = Path(out)
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    paths = tuple(_absolute(brain_file(path)) for path in maps)
    plan = RunPlan(_absolute(source), start, stop, on_bad_frame, paths)
    require_free(out, plan.source, overwrite)
    if any(Path(path).parent == out.resolve() for path in paths):
        raise RunError(f"{out}: holds the stored map, which would be lost; take another folder")
    stored = [load_brain(path) for path in paths]  # first: nothing is written if it fails
    config = _located(config or (stored[0].config if stored else BrainConfig()))
    opened = open_source(source, config.frame_rate_hz)
    if opened.n_frames is not None and start >= opened.n_frames:
        raise RunError(
            f"{source}: has {counted(opened.n_frames, 'frame')}, none from --start {start} on"
        )
    brain, summary = NavigationBrain(config, features=features), RunSummary()
    brain.about = (plan.name, preset, recorded(plan.source))
    for one in stored:
        brain.store(one)
    _announce(on_start, stop, opened)
    with one_thread(brain.config.threads), torch.inference_mode(), _asked_to_stop() as asked:
        steps = _steps(brain, opened, plan, summary)
        first = next(steps, None)  # an earlier run is not touched before this works
        if first is None:
            raise RunError(f"{source}: no usable frame{_and_why(summary.skipped)}")
        with RowWriter.create(out) as output:
            recorder = TensorBoardRecorder(out / "events") if tensorboard else NullRecorder()
            keep = _keeper(brain, plan, out, summary, output, save_every_s)
            _drive(brain, chain([first], steps), output, recorder, summary, on_step, asked, keep)
        summary.unused = list(opened.unused)
        return write_results(brain, plan, out, summary)


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
    """Go on where a run stopped; its files end up equal to those of an uncut run.

    Args:
        out: Folder of the run.
        stop: Frame to stop before; the end of the source if not given.
        tensorboard: Append to ``events/`` too.
        on_step: Called after each frame.
        on_start: As for :func:`run`.
        features: The network that makes views, where one was passed to the run.
        save_every_s: As for :func:`run`.

    Raises:
        RunError: If the folder holds no run, parts of it are missing, or it is past ``stop``.
        CheckpointError: If its brain cannot be loaded.
    """
    out = Path(out)
    plan = replace(read_plan(out), stop=stop)
    brain = load_brain(out / "brain.safetensors", features=features)
    seen, first = brain.clock.frames_seen, brain.clock.frame + 1
    if stop is not None and stop < first:
        raise RunError(f"{out}: is at frame {first} already; --stop {stop} is behind that")
    opened = open_source(plan.source, brain.config.frame_rate_hz)
    summary = _read_summary(out)
    _announce(on_start, stop, opened)
    onward = replace(plan, start=max(first, plan.start))
    with one_thread(brain.config.threads), torch.inference_mode(), _asked_to_stop() as asked:
        steps = _steps(brain, opened, onward, summary)
        with RowWriter.reopen(out, seen) as output:
            recorder = TensorBoardRecorder(out / "events") if tensorboard else NullRecorder()
            keep = _keeper(brain, plan, out, summary, output, save_every_s)
            _drive(brain, steps, output, recorder, summary, on_step, asked, keep)
        summary.unused = list(opened.unused)
        return write_results(brain, plan, out, summary)


def _announce(
    on_start: Callable[[int | None], None] | None, stop: int | None, source: Source
) -> None:
    if on_start is not None:
        on_start(min((n for n in (stop, source.n_frames) if n is not None), default=None))


def _steps(
    brain: NavigationBrain, source: Source, plan: RunPlan, summary: RunSummary
) -> Iterator[tuple[Frame, StepResult]]:
    """Yield each frame with what the brain made of it; skipped ones are noted."""
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
            yield frame, result


def _drive(
    brain: NavigationBrain,
    steps: Iterable[tuple[Frame, StepResult]],
    output: RowWriter,
    recorder: Recorder,
    summary: RunSummary,
    on_step: Callable[[StepResult], None] | None,
    asked: list[int],
    keep: Callable[[], None],
) -> None:
    wall = time.perf_counter() - summary.seconds  # a resumed run goes on counting
    cpu = time.process_time() - summary.cpu_seconds

    def note_time() -> None:
        summary.seconds = time.perf_counter() - wall
        summary.cpu_seconds = time.process_time() - cpu

    try:
        with contextlib.closing(recorder):
            for frame, result in steps:
                output.write(result, frame, brain)
                recorder.step(result, frame, brain)
                summary.added += 1
                if on_step is not None:
                    on_step(result)
                note_time()
                keep()
                if asked:
                    break
    except (SourceError, MapError) as error:  # what was mapped so far is kept
        summary.failure = str(error)
    summary.interrupted = bool(asked)
    # A resumed run meets again the bad frames after its last good one: they count once.
    summary.skipped = list(dict.fromkeys(summary.skipped))
    note_time()


def _keeper(
    brain: NavigationBrain,
    plan: RunPlan,
    out: Path,
    summary: RunSummary,
    output: RowWriter,
    every_s: float,
) -> Callable[[], None]:
    """Return what saves a run that goes on still, when it is time to: a kill loses no more."""
    saved = time.monotonic()

    def keep() -> None:
        nonlocal saved
        if every_s and time.monotonic() - saved >= every_s:
            output.flush()  # a brain must not have seen frames that have no row
            so_far = replace(summary, frames=brain.clock.frames_seen, interrupted=True)
            _save(brain, plan, out, so_far)
            saved = time.monotonic()

    return keep


def _save(brain: NavigationBrain, plan: RunPlan, out: Path, summary: RunSummary) -> None:
    """Write what a run goes on from."""
    write_text(out / "config.toml", to_toml(brain.config) + plan.to_toml())
    write_text(out / "metrics.json", json.dumps(summary.to_dict(), indent=2) + "\n")
    save_brain(brain, out / "brain.safetensors")


def _and_why(skipped: list[str]) -> str:
    return (
        f"; {counted(len(skipped), 'was', 'were')} skipped, the first: {skipped[0]}"
        if skipped
        else ""
    )


@contextlib.contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """Let Ctrl-C end the run after the frame in hand, so that no stage is ahead of another.

    A second Ctrl-C interrupts at once. Only the main thread can take signals; and where they are
    ignored, someone else sees to them.
    """
    asked: list[int] = []
    ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    if ignored or threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def note(number: int, _frame: object) -> None:
        asked.append(number)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)


def write_results(
    brain: NavigationBrain, plan: RunPlan, out: Path, summary: RunSummary
) -> RunSummary:
    """Write what a brain and its trace tell, as the files of a run.

    Args:
        brain: At the end of the run.
        plan: What it read.
        out: Folder that holds ``trace.f64``.
        summary: So far; it is completed.

    Raises:
        RunError: If the folder cannot be written.
    """
    trace = read_trace(out, min_rows=0)
    track = trajectory(brain, trace)
    truth = true_poses(trace)
    odometry = odometry_track(brain.config, trace)
    on_map = np.isfinite(track[:, 0])
    summary.unplaced = int((~on_map).sum())
    drive = brain.sessions.this_drive() if brain.sessions.sessions else set()
    for name in ("merges", "refusals"):
        reports = getattr(brain.sessions, name)
        setattr(summary, name, [r for r in reports if r["partial_sessions"][-1] in drive])
    summary.not_joined = brain.not_joined()
    summary.frames = brain.clock.frames_seen
    summary.counts = {
        "templates": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(*brain.map.links[:2]).sum()),
    }
    if brain.config.has("place"):
        cells = brain.navigation
        summary.counts |= {
            "place_cells": int(cells.place.n_cells),
            "walls": int(cells.walls.n_walls),
            "activated_boundary_cells": int(cells.familiarity.n_activated()),
            "lost_s": round(cells.now.lost_s, 3),
        }
    if brain.config.has("semantic"):
        summary.counts["landmarks"] = brain.semantic.n
    if truth is not None:
        # A robot that has not moved: nothing tells how to lay its track over the truth.
        with contextlib.suppress(MapError):
            summary.accuracy = {
                f"{name}_rmse_m": absolute_trajectory_error(
                    xy[on_map, :2], truth[on_map, :2], "rigid"
                ).rmse
                for name, xy in (("ate", track), ("odometry_ate", odometry))
            }
    try:
        # What cannot be made again comes first: one who kills the run now can still resume it.
        _save(brain, plan, out, summary)
        write_text(out / "experiences.csv", experiences_csv(brain))
        write_text(out / "links.csv", links_csv(brain.map.links))
        if brain.config.has("semantic"):
            write_text(out / LANDMARKS_FILE, landmarks_csv(brain))
        write_tum(out / "trajectory.tum", Track(trace["time_s"][on_map], track[on_map]))
        draw_map(brain, plan, trace, out / "map.png")
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return summary


def _located(config: BrainConfig) -> BrainConfig:
    """Say where a network's weights lie from anywhere: a run may be resumed in another folder."""
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
    """Return the day on which a recording's file was written, or nothing where there is none."""
    path = Path(source)
    if not path.exists():  # made on the fly, or of two recordings
        return ""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).date().isoformat()


def _read_summary(out: Path) -> RunSummary:
    old = read_metrics(out)
    return RunSummary(
        seconds=float(old["seconds"]),
        cpu_seconds=float(old["cpu_seconds"]),
        skipped=list(old["skipped"]),
        pictures=bool(old.get("pictures")),
    )
