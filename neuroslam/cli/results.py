"""Commands that look at what was made: inspect, verify, export, evaluate, plot, report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.table import Table

from neuroslam.cli.options import MapFile, RunFolder
from neuroslam.cli.output import USER_ERROR, complain, say
from neuroslam.cli.tables import new_table

if TYPE_CHECKING:
    from neuroslam.evaluation.trajectory import AlignmentMode


def inspect_command(path: MapFile) -> int:
    """Say what is in a map."""
    from neuroslam.runs.inspect import inspect

    table = new_table("what", "is", title=str(path), headed=False)
    for name, value in inspect(path):
        table.add_row(name, value)
    say(table)
    return 0


def verify_command(path: MapFile) -> int:
    """Check a map: exit 0 if it is sound, 2 with its faults if not."""
    from neuroslam.runs.verify import verify

    faults = verify(path)
    for fault in faults:
        complain("verify", fault)
    if not faults:
        say(f"{path}: sound")
    return USER_ERROR if faults else 0


def export_command(
    path: MapFile,
    to: Annotated[Path, typer.Argument(metavar="TO", help="File to write.")],
    kind: Annotated[
        str | None, typer.Option(help="tum, g2o, graphml or nir; as TO ends if not given.")
    ] = None,
) -> int:
    """Write a map for other programs: TUM, g2o, GraphML, NIR."""
    from neuroslam.runs.export import export

    say(f"Written: {export(path, to, kind)}")
    return 0


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
    from neuroslam.runs.evaluate import evaluate

    table = Table(title=f"{track} against the truth, {align} alignment")
    for column in ("error", "rmse", "mean", "median", "max", "unit", "frames"):
        table.add_column(column, justify="left" if column in ("error", "unit") else "right")
    notes: list[str] = []
    mode = cast("AlignmentMode", align)  # looked at there
    for name, found, unit in evaluate(track, truth, mode, notes.append):
        table.add_row(name, *(f"{value:.4f}" for value in found[:4]), unit, str(found.n))
    say(table)
    for note in notes:
        say(note)
    return 0


def plot_command(
    out: RunFolder,
    to: Annotated[Path | None, typer.Option(help="Folder for the figures; DIR itself.")] = None,
) -> int:
    """Draw the map, the cells that the brain has, and counts over time."""
    from neuroslam.runs.plot import plot

    for path in plot(out, to or out):
        say(str(path))
    return 0


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

    say(f"Written: {write_report(out, to, pictures_mb=pictures)}")
    return 0
