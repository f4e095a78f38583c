"""The command line: each command parses, calls one function of the library, and prints."""

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from importlib.metadata import version
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

# A brain's arrays are small: one thread is faster, and the libraries look at this when they load.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Column, Table
from typer.core import TyperGroup

from neuroslam.errors import ConfigError, NeuroslamError, counted
from neuroslam.experiments import EXPERIMENTS

if TYPE_CHECKING:
    from neuroslam.runs.run import RunSummary
    from neuroslam.types import StepResult


class _Commands(TyperGroup):
    """Commands whose interruption is told by :func:`main`; typer's own would say nothing."""

    def invoke(self, ctx: typer.Context) -> object:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None


app = typer.Typer(
    cls=_Commands,
    help="Brain-inspired SLAM: from a video to a map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
console = Console(markup=False, soft_wrap=True)  # for paths: brackets in them, one line each

INTERRUPTED = 130
USER_ERROR = 2
REFUSED = 3


class OnBadFrame(StrEnum):
    """What to do with a frame that cannot be used."""

    stop = "stop"
    skip = "skip"


Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")]
MapFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="Brain file, or the folder of a run.")
]
RunFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` wrote.")]
NoTensorboard = Annotated[bool, typer.Option("--no-tensorboard", help="Write no events/.")]
Stop = Annotated[int | None, typer.Option(help="Stop before this frame.")]
Confirm = Annotated[
    int | None,
    typer.Option(
        min=1, help="Places that must agree before maps are joined; 1: the first view decides."
    ),
]


Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="Video, folder or tar of images, image list, CSV of motion, npz trajectory, "
        "TUM, KITTI or EuRoC folder, ROS bag, camera:0, VIDEO+MOTION.csv, arena:NAME or "
        "world:NAME.",
    ),
]
Sources = Annotated[list[str], typer.Argument(metavar="SOURCE...", help="As for `run`.")]
Preset = Annotated[str | None, typer.Option(help="A preset; see `neuroslam presets`.")]
ConfigFile = Annotated[
    Path | None, typer.Option(help="TOML, or an OpenRatSLAM .ini/.txt; laid over the preset.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="As view.threshold=0.04; laid over both."),
]
Start = Annotated[int, typer.Option(help="First frame.")]
BadFrame = Annotated[
    OnBadFrame, typer.Option(help="Stop at a frame that cannot be used, or skip it.")
]
SaveEvery = Annotated[
    float,
    typer.Option(
        metavar="SECONDS", min=0.0, help="Save while driving, for `resume`; 0: only at the end."
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")
]
Jobs = Annotated[
    int | None,
    typer.Option(min=1, help="So many at once; 1, or as many as the cluster has processors."),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="ADDRESS", help="Use a Ray cluster: HOST:PORT, auto, or local to start one"
    ),
]


def _tell_version(asked: bool) -> None:
    if asked:
        console.print(f"neuroslam {version('neuroslam')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_tell_version, is_eager=True, help="Tell the version."),
    ] = False,
) -> None:
    """Take the options that belong to no command."""


@app.command("run")
def run_command(
    source: Source,
    out: Out,
    preset: Preset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    maps: Annotated[
        list[Path] | None,
        typer.Option(
            "--map",
            metavar="OLD",
            help="Stored map to go on in, a run's folder or a brain file; several are allowed. "
            "Without --preset or --config its config is taken.",
        ),
    ] = None,
    confirm: Confirm = None,
    start: Start = 0,
    stop: Stop = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    no_tensorboard: NoTensorboard = False,
    save_every: SaveEvery = 60.0,
    overwrite: Overwrite = False,
) -> int:
    """Map a SOURCE; write map, track and brain into a folder."""
    from neuroslam.brain import read_checkpoint
    from neuroslam.runs.files import brain_file
    from neuroslam.runs.run import resolve_config, run

    if confirm is not None:
        assignments = [*(assignments or ()), f"sessions.confirm={confirm}"]
    base = read_checkpoint(brain_file(maps[0]))[0] if maps else None
    settings = resolve_config(preset, config, tuple(assignments or ()), base)
    with _progress(source) as (on_start, on_step):
        summary = run(
            source,
            out,
            settings,
            maps=maps or (),
            preset=preset or "",
            start=start,
            stop=stop,
            on_bad_frame=on_bad_frame.value,
            tensorboard=not no_tensorboard,
            overwrite=overwrite,
            on_step=on_step,
            on_start=on_start,
            save_every_s=save_every,
        )
    return _report(summary, out, "run")


@app.command("resume")
def resume_command(
    out: RunFolder,
    stop: Stop = None,
    no_tensorboard: NoTensorboard = False,
    save_every: SaveEvery = 60.0,
) -> int:
    """Go on where the run in DIR stopped."""
    from neuroslam.runs.run import resume

    with _progress(str(out)) as (on_start, on_step):
        summary = resume(
            out,
            stop=stop,
            tensorboard=not no_tensorboard,
            on_step=on_step,
            on_start=on_start,
            save_every_s=save_every,
        )
    if not summary.added and not summary.failure and not summary.interrupted:
        console.print("Nothing was left to do: the run had come to its end already")
    return _report(summary, out, "resume")


@app.command("merge")
def merge_command(
    first: Annotated[
        Path, typer.Argument(metavar="A", help="Folder or brain file of the map merged into.")
    ],
    second: Annotated[
        Path, typer.Argument(metavar="B", help="Folder or brain file of the session merged.")
    ],
    out: Out,
    confirm: Confirm = None,
    overwrite: Overwrite = False,
) -> int:
    """Merge two finished sessions; exit 0 merged, 3 refused, and then nothing is written."""
    from neuroslam.runs.merge import merge_runs

    summary, reports = merge_runs(first, second, out, confirm=confirm, overwrite=overwrite)
    for report in reports:
        _print_report(report.to_dict())
    if summary is None:
        return REFUSED
    _print_not_joined(summary)
    console.print(f"Written: {out}")
    return 0


@app.command("tune")
def tune_command(
    source: Source,
    out: Out,
    preset: Preset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    stop: Stop = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier tuning in the folder.")
    ] = False,
) -> int:
    """Find the parameters of a SOURCE's pictures, without truth; write a config for `run`."""
    from neuroslam.runs.run import resolve_config
    from neuroslam.tuning import tune

    with _stages("tune") as on_stage:
        tuning = tune(
            source,
            out,
            resolve_config(preset, config, tuple(assignments or ())),
            stop=stop,
            overwrite=overwrite,
            on_stage=on_stage,
        )
    table = _table("parameter", "before", "found", "because")
    for key, (before, found, why) in tuning.changes.items():
        table.add_row(key, *("none" if v is None else _shown(v) for v in (before, found)), why)
    console.print(table)
    for note in tuning.notes:
        console.print(note)
    for name, trial in (("before", tuning.before), ("found", tuning.after)):
        console.print(
            f"{name}: {trial.n_places} places, {trial.n_links} links, "
            f"inconsistency {_shown(trial.inconsistency) or 'not known'} (0: none, 1: useless)"
        )
    console.print(tuning.verdict)
    console.print(f"Written: {out}; now: neuroslam run {source} --config {out}/config.toml -o map")
    return 0


@app.command("sweep")
def sweep_command(
    sources: Sources,
    out: Out,
    vary: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=A,B,C", help="As view.threshold=0.03,0.05; several are allowed."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, help="So many runs of each, with other noise and random weights."),
    ] = None,
    preset: Preset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    start: Start = 0,
    stop: Stop = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    jobs: Jobs = None,
    ray: RayAddress = None,
    overwrite: Overwrite = False,
) -> int:
    """Map sources with all values of what is varied; exit 2 if a run failed."""
    from neuroslam.runs.sweep import given, sweep

    so_far = (0, 0)

    def note(*done_and_total: int) -> None:
        nonlocal so_far
        so_far = done_and_total
        on_done("runs", *so_far)

    with _counting("sweep") as on_done:
        try:
            rows = sweep(
                sources,
                out,
                vary=vary or (),
                seeds=seeds,
                preset=preset,
                config=config,
                assignments=assignments or (),
                start=start,
                stop=stop,
                on_bad_frame=on_bad_frame.value,
                jobs=jobs,
                ray=ray,
                overwrite=overwrite,
                on_done=note,
            )
        except KeyboardInterrupt:
            if so_far[0]:
                done, total = so_far
                console.print(f"{done} of {counted(total, 'run')} ended: {out / 'sweep.csv'}")
            raise
    figures = ("templates", "experiences", "loop_closures", "place_cells", "ate_rmse_m")
    keys = [*given(rows), *(key for key in figures if any(row.get(key) for row in rows))]
    console.print(_down([{key: row.get(key, "") for key in keys} for row in rows], "sweep"))
    failed = [row for row in rows if row["error"]]
    for row in failed:
        _complain("sweep", f"{row['run']}: {row['error']}")
    console.print(f"Written: {out}")
    return USER_ERROR if failed else 0


@app.command("fleet")
def fleet_command(
    sources: Sources,
    out: Out,
    preset: Preset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    confirm: Confirm = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    jobs: Jobs = None,
    ray: RayAddress = None,
    overwrite: Overwrite = False,
) -> int:
    """Map each SOURCE as a robot's session, merge all; exit 3: some stay apart, 2: one failed."""
    from neuroslam.runs.fleet import fleet
    from neuroslam.runs.run import resolve_config

    if confirm is not None:
        assignments = [*(assignments or ()), f"sessions.confirm={confirm}"]
    with _counting("fleet") as on_done:
        report = fleet(
            sources,
            out,
            resolve_config(preset, config, tuple(assignments or ())),
            preset=preset or "",
            on_bad_frame=on_bad_frame.value,
            jobs=jobs,
            ray=ray,
            overwrite=overwrite,
            on_done=on_done,
        )
    for row in report.sessions:
        figures = "failed"
        if "frames" in row:
            figures = f"{counted(row['frames'], 'frame')}, {counted(row['experiences'], 'place')}"
        console.print(f"session {row['session']}: {row['source']}: {figures}")
    for row in report.tree:
        first, second = ("+".join(map(str, row[name])) for name in ("first", "second"))
        done = "merged" if row["merged"] else "not merged"
        console.print(f"level {row['level']}: {first} with {second}: {done}: {row['reason']}")
    if report.merged:
        error = report.merged.get("ate_rmse_m")
        console.print(
            f"one map of sessions {', '.join(map(str, report.merged['sessions']))}: "
            f"{counted(report.merged['experiences'], 'place')}, "
            f"{counted(report.merged['links'], 'link')}"
            + ("" if error is None else f"; error against the truth (ATE, rigid) {error:.3f} m")
        )
    for part in report.apart:
        console.print(f"stays apart: sessions {', '.join(map(str, part['sessions']))}")
    console.print(f"Written: {out}")
    for row in report.failed:
        _complain("fleet", f"session {row['session']}: {row['error']}")
    return USER_ERROR if report.failed else REFUSED if report.apart else 0


@app.command("inspect")
def inspect_command(path: MapFile) -> int:
    """Say what is in a map."""
    from neuroslam.runs.inspect import inspect

    table = _table("what", "is", title=str(path), headed=False)
    for name, value in inspect(path):
        table.add_row(name, value)
    console.print(table)
    return 0


@app.command("verify")
def verify_command(path: MapFile) -> int:
    """Check a map: exit 0 if it is sound, 2 with its faults if not."""
    from neuroslam.runs.inspect import verify

    faults = verify(path)
    for fault in faults:
        _complain("verify", fault)
    if not faults:
        console.print(f"{path}: sound")
    return USER_ERROR if faults else 0


@app.command("export")
def export_command(
    path: MapFile,
    to: Annotated[Path, typer.Argument(metavar="TO", help="File to write.")],
    kind: Annotated[
        str | None, typer.Option(help="tum, g2o, graphml or nir; as TO ends if not given.")
    ] = None,
) -> int:
    """Write a map for other programs: TUM, g2o, GraphML, NIR."""
    from neuroslam.runs.export import export

    console.print(f"Written: {export(path, to, kind)}")
    return 0


@app.command("demo")
def demo_command(out: Out = Path("demo")) -> int:
    """Map an embedded world in two sessions that become one map."""
    from neuroslam.runs.demo import demo

    with _progress("world:corridor") as (on_start, on_step):
        rows = demo(out, on_step, on_start)
    table = Table(title="A corridor in two sessions, the second from an unknown place")
    table.add_column("what")
    table.add_column("figure", justify="right")
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)
    console.print(f"Figures: {out / 'summary.png'}, {out / 'sessions.png'}")
    console.print(f"Runs: {out / 'first'}, {out / 'second'}")
    return 0


@app.command("evaluate")
def evaluate_command(
    track: Annotated[
        Path, typer.Argument(metavar="TRACK", help="A run's folder, or a track as a TUM file.")
    ],
    truth: Annotated[
        Path | None, typer.Option(help="True track, TUM; a run of a world has its own.")
    ] = None,
    align: Annotated[str, typer.Option(help="rigid, similarity or none.")] = "rigid",
) -> int:
    """Compare a track with the truth."""
    from neuroslam.runs.review import evaluate

    table = Table(title=f"{track} against the truth, {align} alignment")
    for column in ("error", "rmse", "mean", "median", "max", "unit", "frames"):
        table.add_column(column, justify="left" if column in ("error", "unit") else "right")
    notes: list[str] = []
    for name, found, unit in evaluate(track, truth, align, notes.append):
        table.add_row(name, *(f"{value:.4f}" for value in found[:4]), unit, str(found.n))
    console.print(table)
    for note in notes:
        console.print(note)
    return 0


@app.command("plot")
def plot_command(
    out: RunFolder,
    to: Annotated[Path | None, typer.Option(help="Folder for the figures; DIR itself.")] = None,
) -> int:
    """Draw the map, the cells that the brain has, and counts over time."""
    from neuroslam.runs.review import plot

    for path in plot(out, to or out):
        console.print(str(path))
    return 0


@app.command("report")
def report_command(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `run` or `merge` wrote.")],
    to: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; DIR/report.html.")
    ] = None,
    pictures: Annotated[
        float, typer.Option(help="Room for pictures of frames, in MB; 0: none.")
    ] = 12.0,
) -> int:
    """Write one HTML page that explains a run; it needs nothing but a browser."""
    from neuroslam.report import write_report

    console.print(f"Written: {write_report(out, to, pictures_mb=pictures)}")
    return 0


@app.command("presets")
def presets_command() -> int:
    """List the presets and what they are for."""
    from neuroslam.config import preset_folder, preset_names

    table = _table("preset", "for")
    for name in preset_names():
        lines = (preset_folder() / f"{name}.toml").read_text(encoding="utf-8").splitlines()
        about = takewhile(lambda line: line.startswith("#"), lines)
        table.add_row(name, " ".join(line.lstrip("# ") for line in about))
    console.print(table)
    return 0


@app.command("experiment")
def experiment_command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of: " + ", ".join(EXPERIMENTS))],
    out: Out,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder that holds the recordings, where the experiment needs some."),
    ] = None,
    jobs: Jobs = None,
    ray: RayAddress = None,
    network: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="view-matching: a network of torchvision too, with the weights of FILE; "
            "repeatable.",
        ),
    ] = None,
) -> int:
    """Repeat an experiment of a paper."""
    from neuroslam.experiments import run_experiment

    networks = dict(_name_and_file(text) for text in network or [])
    rows = run_experiment(name, data, out, jobs, ray, networks)
    few = len({key for row in rows for key in row}) <= 9
    for table in [_down(rows, name)] if few else _across(rows, name):
        console.print(table)
    console.print(f"Written: {out}")
    return 0


def _name_and_file(text: str) -> tuple[str, Path]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise ConfigError(f"--network {text!r}: expected NAME=FILE, as resnet18.layer3=weights.pth")
    return name, Path(file)


def _table(*names: str, title: str | None = None, headed: bool = True) -> Table:
    """Make a table whose words are never cut: a name that is told is one to be copied."""
    columns = (Column(name, overflow="fold") for name in names)
    return Table(*columns, title=title, show_header=headed)


def _down(rows: list[dict[str, Any]], title: str) -> Table:
    """Make a table of a line a row."""
    table = _table(*(key.replace("_", " ") for key in rows[0]), title=title)
    for row in rows:
        table.add_row(*map(_shown, row.values()))
    return table


def _across(rows: list[dict[str, Any]], title: str) -> Iterator[Table]:
    """Make tables of a column a row, three columns each: for many figures of few maps."""
    for first in range(0, len(rows), 3):
        some = rows[first : first + 3]
        table = Table(title=title, show_header=False)
        for key in dict.fromkeys(key for row in some for key in row):
            cells = [_shown(row.get(key, "")) for row in some]
            if any(cells):
                table.add_row(key.replace("_", " "), *cells)
        yield table


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if value == value else ""  # NaN is not equal to itself
    text = "; ".join(map(_shown, value)) if isinstance(value, list) else str(value)
    return text.replace("_", " ")


@contextmanager
def _stages(name: str) -> Iterator[Callable[[str], None]]:
    """Show what is being done, and for how long already; yield what tells it."""
    columns = (TextColumn("{task.description}", style="bold", markup=False), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(name, total=None)
        yield lambda stage: bar.update(task, description=f"{name}: {stage}")


@contextmanager
def _counting(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show how many of several runs are done; yield what tells it."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.completed:.0f} of {task.total:.0f}"),
        TimeElapsedColumn(),
    )
    on_screen = console.is_terminal
    with Progress(
        *columns, console=console, transient=True, refresh_per_second=2, disable=not on_screen
    ) as bar:
        task = bar.add_task(name, total=1)

        def on_done(what: str, done: int, total: int) -> None:
            bar.update(task, description=f"{name}: {what}", completed=done, total=total)

        yield on_done


@contextmanager
def _progress(
    name: str,
) -> Iterator[tuple[Callable[[int | None], None], Callable[["StepResult"], None]]]:
    """Show frame, frames/s, views and places while a run goes; yield what tells them."""
    columns = (
        TextColumn("{task.description}", style="bold", markup=False),
        BarColumn(bar_width=12),
        TaskProgressColumn(),
        TextColumn("{task.completed:.0f}, {task.fields[rate]:.0f}/s"),
        TextColumn("{task.fields[templates]} views, {task.fields[experiences]} places"),
        TimeElapsedColumn(),
    )
    import time

    shown = (Path(name).name or name)[:18]  # all of it fits 80 columns
    on_screen = console.is_terminal
    with Progress(
        *columns, console=console, transient=True, refresh_per_second=5, disable=not on_screen
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


def _report(summary: "RunSummary", out: Path, command: str) -> int:
    figures = summary.to_dict()
    for note in summary.skipped[:3]:
        _complain(command, f"skipped: {note}")
    if len(summary.skipped) > 3:
        _complain(command, f"skipped: {len(summary.skipped) - 3} more, see metrics.json")
    console.print(
        f"{counted(figures['frames'], 'frame')} at {figures['frames_per_s']:.0f} frames/s: "
        + ", ".join(
            counted(figures[f"{what}s".replace(" ", "_")], what)
            for what in ("template", "experience", "link", "loop closure")
        )
    )
    for note in summary.unused:
        console.print(note)
    if not figures["experiences"]:
        console.print(
            "No places: no picture has the contrast that view.min_contrast asks for"
            if summary.pictures
            else "No places: there were no pictures. Without a camera: --preset slrb"
        )
    if "place_cells" in figures:
        lost = figures["lost_s"]
        console.print(
            f"{counted(figures['place_cells'], 'place cell')}, "
            f"{counted(figures['walls'], 'stretch of wall', 'stretches of wall')}; "
            + (f"lost for {lost:.0f} s: walls contradicted the map" if lost else "never lost")
        )
    for report in summary.merges:
        _print_report(report)
    for report in summary.refusals[:3]:
        _print_report(report)
    _print_not_joined(summary)
    if summary.unplaced:
        console.print(
            f"{summary.unplaced} of {summary.frames} frames are on maps that were not joined; "
            "where the robot only seemed to be carried: --set sessions.carried=ignore"
        )
    if summary.accuracy:
        console.print(
            f"error against the truth (ATE, rigid): map {summary.accuracy['ate_rmse_m']:.3f} m, "
            f"odometry alone {summary.accuracy['odometry_ate_rmse_m']:.3f} m"
        )
    console.print(f"Written: {out}")
    if summary.failure:
        _complain(command, f"stopped early: {summary.failure}")
        return USER_ERROR
    if summary.interrupted:
        _complain(command, f"interrupted; go on with: neuroslam resume {out}")
        return INTERRUPTED
    return 0


def _print_not_joined(summary: "RunSummary") -> None:
    for stored in summary.not_joined[:3]:
        console.print(f"not joined: the map of {', '.join(stored['sessions'])}; {stored['reason']}")
    if len(summary.not_joined) > 3:
        console.print(f"not joined: {len(summary.not_joined) - 3} more maps, see metrics.json")


def _print_report(report: dict[str, Any]) -> None:
    from neuroslam.merging.merge import MergeReport

    first, *others = MergeReport(**report).lines()
    at = "" if report["at_frame"] is None else f"frame {report['at_frame']}: "
    console.print(f"{at}{first}")
    for line in others:
        console.print(f"  {line}")


@contextmanager
def _quiet_writers() -> Iterator[None]:
    """Let no thread print a disk's fault: TensorBoard's writer raises it again where it is used."""
    before = threading.excepthook

    def failed(what: threading.ExceptHookArgs) -> None:
        if not isinstance(what.exc_value, OSError):
            before(what)

    threading.excepthook = failed
    try:
        yield
    finally:
        threading.excepthook = before


def _complain(command: str, text: str) -> None:
    print(f"neuroslam {command}: {text}", file=sys.stderr)


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 is success, 2 a mistake the user can mend, 130 an interruption."""
    arguments: list[Any] = sys.argv[1:] if argv is None else argv
    command = arguments[0] if arguments else ""
    try:
        with _quiet_writers():
            return app(args=arguments, prog_name="neuroslam", standalone_mode=False) or 0
    except typer.Abort:
        _complain(command, "interrupted")
        return INTERRUPTED
    except typer.TyperException as error:
        error.show()
        return USER_ERROR
    except NeuroslamError as error:
        _complain(command, str(error))
        return USER_ERROR
