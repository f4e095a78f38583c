"""Commands on results: inspect, ask, verify, export, evaluate, plot, report."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.table import Table

from neuroslam.cli.options import Landmarks, MapFile, RunFolder
from neuroslam.cli.output import USER_ERROR, complain, say
from neuroslam.cli.tables import new_table
from neuroslam.errors import counted

if TYPE_CHECKING:
    from neuroslam.evaluation.trajectory import AlignmentMode


def inspect_command(
    path: MapFile,
    tables: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Write bindings, experiences, goals, rates ... as CSV files there."
        ),
    ] = None,
) -> int:
    """List the content of a map and its sessions."""
    from neuroslam.runs.inspect import inspect, write_tables

    table = new_table("quantity", "value", title=str(path), headed=False)
    for name, value in inspect(path):
        table.add_row(name, value)
    say(table)
    if tables is not None:
        say(f"Written: {counted(len(write_tables(path, tables)), 'table')} in {tables}")
    return 0


def ask_command(
    path: Annotated[
        Path,
        typer.Argument(metavar="MAP", help="Folder of a run, brain file, or semantic map file."),
    ],
    question: Annotated[
        str,
        typer.Argument(
            metavar="QUESTION",
            help="'what is at X,Y', 'what is in X0,Y0,X1,Y1', 'where is NAME', 'which landmarks "
            "are BLUE', or 'the whole map'.",
        ),
    ],
    to: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE.png", help="Picture to write.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")] = False,
    landmarks: Landmarks = None,
    within: Annotated[
        float | None,
        typer.Option(metavar="M", min=0.0, help="Distance within which something is at X,Y."),
    ] = None,
) -> int:
    """Ask a semantic map a question; the answer has words and coordinates in metres."""
    from neuroslam.errors import RunError
    from neuroslam.figures.style import save
    from neuroslam.runs.ask import AskedMap

    if to is not None and to.suffix.lower() != ".png":
        raise RunError(f"{to}: expected a name that ends in .png")
    asked = AskedMap(path, landmarks)
    answer = asked.ask(question, within)
    if to is not None:
        save(asked.draw(answer), to)
    if as_json:
        print(json.dumps(answer.to_dict(), allow_nan=False))
        return 0
    if answer.found:
        extra = {"at": ["distance (m)"], "box": ["share in box"]}.get(answer.question.form, [])
        table = new_table("name", "x (m)", "y (m)", *extra, "kind", "words", title=question)
        for one in answer.found:
            number = one.share if answer.question.form == "box" else one.distance_m
            x, y = one.position_m
            more = [f"{number:.2f}"] if extra else []
            table.add_row(one.name, f"{x:.2f}", f"{y:.2f}", *more, one.kind, one.words)
        say(table)
    if answer.note:
        say(answer.note[:1].upper() + answer.note[1:])
    if to is not None:
        say(f"Written: {to}")
    return 0


def verify_command(path: MapFile) -> int:
    """Check a map for faults; exit 2 if there are any."""
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
        str | None, typer.Option(help="tum, g2o, graphml or nir; default: the suffix of TO.")
    ] = None,
) -> int:
    """Export a map as TUM, g2o, GraphML or NIR."""
    from neuroslam.runs.export import export

    say(f"Written: {export(path, to, kind)}")
    return 0


def evaluate_command(
    track: Annotated[Path, typer.Argument(metavar="TRACK", help="Folder of a run, or a TUM file.")],
    truth: Annotated[
        Path | None, typer.Option(help="Ground truth as a TUM file; a run of a world has its own.")
    ] = None,
    align: Annotated[str, typer.Option(help="rigid, similarity or none.")] = "rigid",
) -> int:
    """Compare a trajectory with the ground truth."""
    from neuroslam.runs.evaluate import evaluate

    table = Table(title=f"{track} and ground truth, {align} alignment")
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
    to: Annotated[Path | None, typer.Option(help="Folder of the figures; default: DIR.")] = None,
) -> int:
    """Draw the map, the cells of the brain, and counts over time."""
    from neuroslam.runs.plot import plot

    for path in plot(out, to or out):
        say(str(path))
    return 0


def report_command(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run or a merge.")],
    to: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; default: DIR/report.html.")
    ] = None,
    pictures: Annotated[
        float, typer.Option(help="Size limit of the images of frames, in MB; 0: no images.")
    ] = 12.0,
) -> int:
    """Write one HTML page that explains a run, for any browser."""
    from neuroslam.report import write_report

    say(f"Written: {write_report(out, to, pictures_mb=pictures)}")
    return 0
