"""Progress while a command works: a bar on a terminal, else a line every ten seconds.

Both are written to standard error, so that standard output has the results alone.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from neuroslam.cli import output
from neuroslam.errors import printable

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from neuroslam.types import StepResult

EVERY_S = 10.0
"""Seconds between two lines of progress without a terminal."""

_RECENT_S = 10.0
"""Time over which the rate is measured."""


class _Rate:
    """Rate over the last seconds, or since the start: what came before may have been slower."""

    def __init__(self) -> None:
        self.points = deque([(time.monotonic(), 0)], maxlen=51)

    def __call__(self, now: float, done: int) -> float:
        self.points.append((now, done))
        while len(self.points) > 2 and now - self.points[1][0] >= _RECENT_S:
            self.points.popleft()
        began, before = self.points[0]
        return (done - before) / max(now - began, 1e-9)


class _Lines:
    """Prints a line of progress to stderr when one is due; nothing on a terminal or if quiet."""

    def __init__(self, on_screen: bool) -> None:
        self.began = self.last = time.monotonic()
        self.silent = on_screen or output.report().quiet

    def __call__(self, text: Callable[[], str]) -> None:
        now = time.monotonic()
        if self.silent or now - self.last < EVERY_S:
            return
        self.last = now
        output.complain(output.report().command, f"{text()}, {clock(now - self.began)} elapsed")


_COMPILES = 10
"""Frames in which steps may be compiled, so that their rate predicts nothing."""


def clock(seconds: float) -> str:
    """Format a duration as a clock shows it.

    Example:
        >>> clock(8.6), clock(75), clock(3725)
        ('0:09', '1:15', '1:02:05')
    """
    minutes, s = divmod(round(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02}:{s:02}" if hours else f"{m}:{s:02}"


def remaining(done: float, total: float | None, rate_hz: float) -> str:
    """Return the time that is left at this rate; empty if it is unknown.

    Example:
        >>> remaining(50, 200, 10.0), remaining(50, None, 10.0)
        ('0:15 left', '')
    """
    if total is None or rate_hz <= 0.0:
        return ""
    return f"{clock(max(0.0, total - done) / rate_hz)} left"


@contextmanager
def _bar(*columns: "ProgressColumn", refresh_per_second: float = 5) -> Iterator[Progress]:
    on_screen = output.error_console.is_terminal and not output.report().quiet
    with Progress(
        *columns,
        console=output.error_console,
        transient=True,
        refresh_per_second=refresh_per_second,
        disable=not on_screen,
    ) as bar:
        yield bar


@contextmanager
def show_stages(name: str) -> Iterator[Callable[[str], None]]:
    """Show the current stage and the elapsed time; yield the function that sets the stage."""
    columns = (TextColumn("{task.description}", style="bold", markup=False), TimeElapsedColumn())
    with _bar(*columns) as bar:
        lines = _Lines(not bar.disable)
        task = bar.add_task(name, total=None)

        def on_stage(stage: str) -> None:
            bar.update(task, description=printable(f"{name}: {stage}"))
            lines(lambda: stage)

        yield on_stage


@contextmanager
def show_runs(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show how many runs are done; yield the function to call after each."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with _bar(*columns, refresh_per_second=2) as bar:
        lines = _Lines(not bar.disable)
        task = bar.add_task(name, total=1, left="")

        def on_done(what: str, done: int, total: int) -> None:
            rate = done / max(time.monotonic() - lines.began, 1e-9)
            left = remaining(done, total, rate)
            bar.update(
                task,
                description=printable(f"{name}: {what}"), completed=done, total=total, left=left,
            )  # fmt: skip
            lines(lambda: ", ".join(filter(None, (f"{done} of {total} {what}", left))))

        yield on_done


@contextmanager
def show_frames(
    name: str,
) -> Iterator[tuple[Callable[[int | None], None], Callable[["StepResult"], None]]]:
    """Show frame, rate, time left, templates and experiences; yield the functions to call."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=8),
        TaskProgressColumn(),
        TextColumn("{task.completed:.0f}, {task.fields[rate]:.0f}/s"),
        TextColumn("{task.fields[templates]} templ., {task.fields[experiences]} exp."),
        TextColumn("{task.fields[left]}"),
    )
    shown = printable(Path(name).name or name)[:14]  # the line fits 80 columns
    with _bar(*columns) as bar:
        lines = _Lines(not bar.disable)
        task = bar.add_task(shown, total=None, rate=0.0, templates=0, experiences=0, left="")
        rate_of, last, done = _Rate(), 0.0, 0
        began = time.monotonic()
        end: int | None = None

        def on_start(total: int | None) -> None:
            nonlocal began, done, end, rate_of
            began, done, end, rate_of = time.monotonic(), 0, total, _Rate()
            bar.update(task, total=total)

        def line(result: "StepResult", rate: float, left: str) -> str:
            size = f"frame {result.frame + 1}"
            if end:
                size = f"{size} of {end} ({100 * (result.frame + 1) / end:.0f} %)"
            counts = f"{result.n_templates} templates, {result.n_experiences} experiences"
            return ", ".join(filter(None, (size, f"{rate:.0f} frames/s", left, counts)))

        def on_step(result: "StepResult") -> None:
            nonlocal done, last
            done += 1
            now = time.monotonic()
            if now - last <= 0.2:
                return
            last = now
            rate = rate_of(now, done)
            left = remaining(result.frame + 1, end, rate) if done > _COMPILES else ""
            bar.update(
                task,
                completed=result.frame + 1, rate=rate, left=left or clock(now - began),
                templates=result.n_templates, experiences=result.n_experiences,
            )  # fmt: skip
            lines(lambda: line(result, rate, left))

        yield on_start, on_step
