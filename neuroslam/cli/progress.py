"""Progress shown on a terminal while a command works."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from neuroslam.cli import output
from neuroslam.errors import printable

if TYPE_CHECKING:
    from neuroslam.types import StepResult


@contextmanager
def show_stages(name: str) -> Iterator[Callable[[str], None]]:
    """Show the current stage and the elapsed time; yield the function that sets the stage."""
    columns = (TextColumn("{task.description}", style="bold", markup=False), TimeElapsedColumn())
    with Progress(
        *columns, console=output.console, transient=True, disable=not output.console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=None)
        yield lambda stage: bar.update(task, description=printable(f"{name}: {stage}"))


@contextmanager
def show_runs(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show how many runs are done; yield the function to call after each."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeElapsedColumn(),
    )
    on_screen = output.console.is_terminal
    with Progress(
        *columns,
        console=output.console,
        transient=True,
        refresh_per_second=2,
        disable=not on_screen,
    ) as bar:
        task = bar.add_task(name, total=1)

        def on_done(what: str, done: int, total: int) -> None:
            bar.update(task, description=printable(f"{name}: {what}"), completed=done, total=total)

        yield on_done


@contextmanager
def show_frames(
    name: str,
) -> Iterator[tuple[Callable[[int | None], None], Callable[["StepResult"], None]]]:
    """Show frame, frames/s, templates and experiences; yield the functions to call."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=12),
        TaskProgressColumn(),
        TextColumn("{task.completed:.0f}, {task.fields[rate]:.0f}/s"),
        TextColumn("{task.fields[templates]} templates, {task.fields[experiences]} exp."),
        TimeElapsedColumn(),
    )
    import time

    shown = printable(Path(name).name or name)[:18]  # the line fits 80 columns
    on_screen = output.console.is_terminal
    with Progress(
        *columns,
        console=output.console,
        transient=True,
        refresh_per_second=5,
        disable=not on_screen,
    ) as bar:
        task = bar.add_task(shown, total=None, rate=0.0, templates=0, experiences=0)
        began = last = 0.0
        done = 0

        def on_start(end: int | None) -> None:
            nonlocal began, done
            began, done = time.perf_counter(), 0
            bar.update(task, total=end)

        def on_step(result: "StepResult") -> None:
            nonlocal done, last
            done += 1
            now = time.perf_counter()
            if now - last > 0.2:
                last = now
                bar.update(
                    task,
                    completed=result.frame + 1,
                    rate=done / (now - began),
                    templates=result.n_templates,
                    experiences=result.n_experiences,
                )

        yield on_start, on_step
