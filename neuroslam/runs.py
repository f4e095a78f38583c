"""A run: a source goes through a brain, and its files are written as it goes."""

import contextlib
import json
import signal
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch

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
from neuroslam.errors import BadFrame, CheckpointError, RunError
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    ErrorStatistics,
    Track,
    absolute_trajectory_error,
    associate,
    read_tum,
    relative_pose_error,
    write_tum,
)
from neuroslam.mapping.experience import closes_loop
from neuroslam.plotting import plot_map, plot_pose_cells, plot_signals, save
from neuroslam.recording import NullRecorder, Recorder, TensorBoardRecorder
from neuroslam.run_files import (
    RowWriter,
    experiences_csv,
    links_csv,
    odometry_track,
    read_frames,
    read_trace,
    trajectory,
    write_text,
)
from neuroslam.sensors import Source, open_source
from neuroslam.types import StepResult

OnBadFrame = Literal["skip", "stop"]


@dataclass(frozen=True)
class RunPlan:
    """What a run reads and how far: the ``[run]`` table of its ``config.toml``."""

    source: str
    start: int = 0
    stop: int | None = None
    on_bad_frame: OnBadFrame = "stop"

    @property
    def skips(self) -> bool:
        """Whether frames that cannot be used are left out."""
        return self.on_bad_frame == "skip"

    def to_toml(self) -> str:
        """Write the table."""
        lines = [f"source = {json.dumps(self.source)}", f"start = {self.start}"]
        if self.stop is not None:
            lines.append(f"stop = {self.stop}")
        lines.append(f'on_bad_frame = "{self.on_bad_frame}"')
        return "\n".join(["\n[run]", *lines]) + "\n"


@dataclass
class RunSummary:
    """What a run did: the content of ``metrics.json``."""

    frames: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    skipped: list[str] = field(default_factory=list)
    interrupted: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    accuracy: dict[str, float] = field(default_factory=dict)
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
            "merges": 0,
            "skipped_frames": len(self.skipped),
            "skipped": self.skipped,
            "interrupted": self.interrupted,
            **self.accuracy,
        }


def resolve_config(
    preset: str | None = None, config: Path | None = None, assignments: tuple[str, ...] = ()
) -> BrainConfig:
    """Lay a config file over a preset, and single assignments over both.

    Raises:
        ConfigError: If a preset, file, key or value cannot be used.

    Example:
        >>> resolve_config(assignments=("view.threshold=0.04",)).view.threshold
        0.04
    """
    values = read_preset(preset) if preset else {}
    origin = f"preset {preset}" if preset else "config"
    if config is not None:
        from_file = read_config_file(config)
        from_file.pop("run", None)  # the table that config.toml of a run has besides
        values, origin = merge_values(values, from_file), f"config {config}"
    for text in assignments:
        values = merge_values(values, parse_assignment(text))
    if assignments:
        origin = "--set" if not config else f"{origin} with --set"
    return build_config(values, origin)


def run(
    source: str | Path,
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    tensorboard: bool = True,
    overwrite: bool = False,
    on_step: Callable[[StepResult], None] | None = None,
) -> RunSummary:
    """Map a source and write the run's files into a folder.

    Args:
        source: Anything :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write; made if missing.
        config: Of the brain; the defaults if not given.
        start: First frame of the source.
        stop: Frame to stop before; the end if not given.
        on_bad_frame: ``stop`` at a frame that cannot be used, or ``skip`` and count it.
        tensorboard: Write ``events/`` too.
        overwrite: Replace the files of an earlier run in ``out``.
        on_step: Called after each frame, e.g. to show progress.

    Returns:
        What was done; a bad frame under ``stop`` ends the run, whose files are still written,
        with ``failure`` saying what it was.

    Raises:
        SourceError: If the source cannot be opened, or has no frame in the range.
        RunError: If ``out`` holds a run already and ``overwrite`` is off, or cannot be written.
    """
    out = Path(out)
    config = config or BrainConfig()
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"frames {start} to {stop}: need 0 <= start < stop")
    plan = RunPlan(_absolute(source), start, stop, on_bad_frame)
    opened = open_source(source, config.frame_rate_hz)  # first: nothing is written if it fails
    if opened.n_frames is not None and start >= opened.n_frames:
        raise RunError(f"{source}: has {opened.n_frames} frames, none from --start {start} on")
    if (out / "brain.safetensors").exists() and not overwrite:
        raise RunError(f"{out}: holds a run already; resume it, take another folder or --overwrite")
    brain = NavigationBrain(config)
    with RowWriter.create(out) as output:
        recorder = TensorBoardRecorder(out / "events") if tensorboard else NullRecorder()
        summary = _drive(brain, opened, plan, output, recorder, RunSummary(), on_step)
    return _finish(brain, plan, out, summary)


def resume(
    out: str | Path,
    *,
    stop: int | None = None,
    tensorboard: bool = True,
    on_step: Callable[[StepResult], None] | None = None,
) -> RunSummary:
    """Go on where a run stopped; its files end up equal to those of an uncut run.

    Args:
        out: Folder of the run.
        stop: Frame to stop before; the end of the source if not given.
        tensorboard: Append to ``events/`` too.
        on_step: Called after each frame.

    Raises:
        RunError: If the folder holds no run, or parts of it are missing.
        CheckpointError: If its brain cannot be loaded.
    """
    out = Path(out)
    plan = replace(read_plan(out), stop=stop)
    brain = load_brain(out / "brain.safetensors")
    opened = open_source(plan.source, brain.config.frame_rate_hz)
    seen, first = brain.clock.frames_seen, brain.clock.frame + 1
    summary = _read_summary(out)
    with RowWriter.reopen(out, seen) as output:
        recorder = TensorBoardRecorder(out / "events") if tensorboard else NullRecorder()
        onward = replace(plan, start=max(first, plan.start))
        summary = _drive(brain, opened, onward, output, recorder, summary, on_step)
    return _finish(brain, plan, out, summary)


def _drive(
    brain: NavigationBrain,
    source: Source,
    plan: RunPlan,
    output: RowWriter,
    recorder: Recorder,
    summary: RunSummary,
    on_step: Callable[[StepResult], None] | None,
) -> RunSummary:
    skip = (lambda fault: summary.skipped.append(str(fault))) if plan.skips else None
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        with (
            _threads(brain.config.threads),
            torch.inference_mode(),
            contextlib.closing(recorder),
            _asked_to_stop() as asked,
        ):
            for frame in source.frames(plan.start, plan.stop, skip):
                try:
                    result = brain(frame)
                except BadFrame as error:
                    if skip is None:
                        raise
                    skip(error)
                    continue
                output.write(result, frame, brain)
                recorder.step(result, frame, brain)
                summary.frames += 1
                if on_step is not None:
                    on_step(result)
                if asked:
                    break
        summary.interrupted = bool(asked)
    except BadFrame as error:
        if not brain.clock.frames_seen:
            raise
        summary.failure = str(error)
    summary.seconds += time.perf_counter() - wall
    summary.cpu_seconds += time.process_time() - cpu
    if not brain.clock.frames_seen:
        raise RunError(f"{plan.source}: no usable frame" + _and_why(summary.skipped))
    return summary


def _and_why(skipped: list[str]) -> str:
    return f"; {len(skipped)} were skipped, the first: {skipped[0]}" if skipped else ""


@contextlib.contextmanager
def _threads(n: int) -> Iterator[None]:
    """One is faster than more for one brain: its arrays are too small to share."""
    torch_threads, cv_threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(n)
    cv2.setNumThreads(n)
    try:
        yield
    finally:
        torch.set_num_threads(torch_threads)
        cv2.setNumThreads(cv_threads)


@contextlib.contextmanager
def _asked_to_stop() -> Iterator[list[int]]:
    """Let Ctrl-C end the run after the frame in hand, so that no stage is ahead of another.

    A second Ctrl-C interrupts at once. Only the main thread can take signals.
    """
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
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


def _finish(brain: NavigationBrain, plan: RunPlan, out: Path, summary: RunSummary) -> RunSummary:
    trace = read_trace(out)
    track = trajectory(brain, trace)
    truth = _truth(trace)
    odometry = odometry_track(brain.config, trace)
    summary.counts = {
        "templates": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(*brain.map.links[:2]).sum()),
    }
    if truth is not None:
        summary.accuracy = {
            f"{name}_rmse_m": absolute_trajectory_error(found[:, :2], truth[:, :2], "rigid").rmse
            for name, found in (("ate", track), ("odometry_ate", odometry))
        }
    try:
        save_brain(brain, out / "brain.safetensors")
        write_text(out / "config.toml", to_toml(brain.config) + plan.to_toml())
        write_text(out / "experiences.csv", experiences_csv(brain))
        write_text(out / "links.csv", links_csv(brain.map.links))
        write_tum(out / "trajectory.tum", Track(trace["time_s"], track))
        write_text(out / "metrics.json", json.dumps(summary.to_dict(), indent=2) + "\n")
        _draw_map(brain, plan, trace, out / "map.png")
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return summary


def evaluate(
    track: str | Path, truth: str | Path | None = None, align: AlignmentMode = "rigid"
) -> list[tuple[str, ErrorStatistics, str]]:
    """Compare a run, or any TUM file, with the true track.

    Args:
        track: Folder of a run, or a TUM file.
        truth: TUM file; a run of a source that knows its truth needs none.
        align: How the track is laid over the truth before it is compared.

    Returns:
        Name of the error, its statistics, its unit.

    Raises:
        NeuroslamError: If a file is missing or damaged, or there is no truth to compare with.
    """
    track, source = Path(track), None
    if align not in get_args(AlignmentMode):
        raise RunError(f"--align {align}: expected one of {', '.join(get_args(AlignmentMode))}")
    if track.is_dir():
        source = read_trace(track)
        track = track / "trajectory.tum"
    found = read_tum(track)
    if truth is not None:
        true = read_tum(Path(truth))
        i, j = associate(found.times_s, true.times_s)
        estimate, reference = found.poses[i], true.poses[j]
    else:
        reference = None if source is None else _truth(source)
        if reference is None:
            raise RunError(f"{track}: its source knows no truth; give one with --truth FILE")
        estimate = found.poses
    relative = relative_pose_error(estimate, reference)
    return [
        (
            "absolute (ATE)",
            absolute_trajectory_error(estimate[:, :2], reference[:, :2], align),
            "m",
        ),
        ("relative, a frame", relative.translation_m, "m"),
        ("relative, a frame", relative.rotation_rad, "rad"),
    ]


def plot(out: str | Path, to: str | Path) -> list[Path]:
    """Draw the figures of a run: map, pose cells at its end, recognition and counts over time.

    Returns:
        The files that were written.
    """
    out, to = Path(out), Path(to)
    brain, plan, trace = load_brain(out / "brain.safetensors"), read_plan(out), read_trace(out)
    to.mkdir(parents=True, exist_ok=True)
    _draw_map(brain, plan, trace, to / "map.png")
    cells = brain.pose_cells
    save(plot_pose_cells(cells.activity.numpy(), cells.estimate), to / "pose_cells.png")
    save(plot_signals(read_frames(out), brain.config.view.threshold), to / "signals.png")
    return [to / name for name in ("map.png", "pose_cells.png", "signals.png")]


def read_plan(out: str | Path) -> RunPlan:
    """Read what a run was made from, out of its ``config.toml``.

    Raises:
        RunError: If the folder holds no run.
    """
    path = Path(out) / "config.toml"
    try:
        return RunPlan(**tomllib.loads(path.read_text(encoding="utf-8"))["run"])
    except FileNotFoundError:
        raise RunError(f"{out}: not a run, it has no config.toml") from None
    except (KeyError, TypeError, tomllib.TOMLDecodeError):
        raise RunError(f"{path}: has no usable [run] table; is it of a run?") from None


def _truth(trace: dict[str, np.ndarray]) -> np.ndarray | None:
    truth = np.column_stack([trace[f"truth_{name}"] for name in ("x_m", "y_m", "theta_rad")])
    return truth if np.isfinite(truth).all() else None


def _draw_map(
    brain: NavigationBrain, plan: RunPlan, trace: dict[str, np.ndarray], path: Path
) -> None:
    links, truth = brain.map.links, _truth(trace)
    figure = plot_map(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        odometry_xy=odometry_track(brain.config, trace)[:, :2],
        track_xy=trajectory(brain, trace)[:, :2],
        truth_xy=None if truth is None else truth[:, :2],
        current=brain.map.pose,
        title=f"{'/'.join(Path(plan.source).parts[-2:])}: {len(trace['time_s'])} frames",
    )
    save(figure, path)


def _absolute(source: str | Path) -> str:
    text = str(source)
    return text if text.startswith("world:") else str(Path(text).resolve())


def _read_summary(out: Path) -> RunSummary:
    try:
        old = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        return RunSummary(
            frames=int(old["frames"]),
            seconds=float(old["seconds"]),
            cpu_seconds=float(old["cpu_seconds"]),
            skipped=list(old["skipped"]),
        )
    except (OSError, ValueError, KeyError, TypeError):
        raise CheckpointError(f"{out}/metrics.json: missing or damaged; cannot resume") from None
