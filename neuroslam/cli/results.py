"""Commands on results: inspect, ask, verify, export, evaluate, plot, report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from neuroslam.cli.options import Axes, Landmarks, MapFile, RunFolder, Truth
from neuroslam.cli.output import USER_ERROR, complain, report, say, summarise
from neuroslam.cli.tables import Table, new_table
from neuroslam.errors import RunError, counted, printable

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
    from neuroslam.runs.inspect import figures_of, inspect, write_tables

    table = new_table("quantity", "value", title=str(path), headed=False)
    rows = inspect(path)
    for name, value in rows:
        table.add_row(name, value)
    say(table)
    if report().as_json:  # reads the brain a second time
        summarise(path=path, **figures_of(path))
    if tables is not None:
        files = write_tables(path, tables)
        summarise(written=files)
        say(f"Written: {counted(len(files), 'table')} in {tables}")
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
    summarise(**answer.to_dict())
    if answer.found:
        extra = {"at": [f"distance ({asked.unit})"], "box": ["share in box"]}.get(
            answer.question.form, []
        )
        uncertain = any(one.covariance_m2 for one in answer.found)
        spread = [f"sd ({asked.unit})"] if uncertain else []
        table = new_table(
            "name", f"x ({asked.unit})", f"y ({asked.unit})", *spread, *extra, "kind", "words",
            title=question,
        )  # fmt: skip
        for one in answer.found:
            number = one.share if answer.question.form == "box" else one.distance_m
            x, y = one.position_m
            more = [f"{number:.2f}"] if extra else []
            if uncertain:
                long, short = one.sigma_m
                more.insert(0, f"{long:.2f} x {short:.2f}" if one.covariance_m2 else "")
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
    summarise(path=path, sound=not faults, faults=faults)
    for fault in faults:
        complain("verify", fault)
    if not faults:
        say(f"{path}: sound")
    return USER_ERROR if faults else 0


def export_command(
    path: MapFile,
    to: Annotated[Path, typer.Argument(metavar="TO", help="File to write.")],
    kind: Annotated[
        str | None, typer.Option(help="tum, g2o, graphml, nir or mcap; default: the suffix of TO.")
    ] = None,
    source: Annotated[
        str | None, typer.Option(help="Source of the pictures of mcap; default: the run's.")
    ] = None,
) -> int:
    """Export a map as TUM, g2o, GraphML, NIR or MCAP."""
    from neuroslam.runs.export import export

    written = export(path, to, kind, source, lambda note: say(f"Left out: {note}"))
    summarise(path=path, written=written)
    say(f"Written: {written}")
    return 0


def plan_command(
    path: MapFile,
    goal: Annotated[
        str, typer.Argument(metavar="GOAL", help="Id of an experience, or X,Y in metres.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder of plan.csv and plan.png; default: the run's."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(help="Experience or X,Y to start from; default: where the robot is."),
    ] = None,
) -> int:
    """Plan the quickest path to an experience or a position of a map."""
    from neuroslam.runs.plan import plan

    found = plan(path, goal, out, start)
    unit = found.unit
    summarise(
        path=path, experiences=found.path, length=found.length_m, duration_s=found.duration_s,
        beside_goal=found.beside_m, unit=unit, written=found.files,
    )  # fmt: skip
    beside = f", {found.beside_m:.2f} {unit} from {goal}" if found.beside_m else ""
    say(
        f"From experience {found.path[0]} to {found.path[-1]}{beside}: "
        f"{counted(len(found.path) - 1, 'link')}, {found.length_m:.2f} {unit}, "
        f"{found.duration_s:.1f} s"
    )
    say(f"Written: {', '.join(str(file) for file in found.files)}")
    return 0


def why_command(
    path: RunFolder,
    frame: Annotated[int, typer.Argument(metavar="FRAME", help="Number of a frame of the run.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE.png", help="Picture; default: why_FRAME.png in the run."
        ),
    ] = None,
) -> int:
    """Explain why a FRAME of a run closed a loop, or which check stopped it."""
    from neuroslam.runs.why import stored_lines, summary_rows, why

    picture = path / f"why_{frame}.png" if out is None else out
    found = why(path, frame, picture)
    summarise(
        path=path, frame=frame, action=found.action, closed=found.closed, verdict=found.verdict,
        checks=[vars(check) for check in found.checks], template=found.candidate,
        experience=found.experience, stored=found.stored, written=picture,
    )  # fmt: skip
    say(f"Frame {frame}, action {found.action}. {found.verdict}")
    table = new_table("check", "value", "limit", "passed")
    for row in summary_rows(found):
        table.add_row(*row)
    say(table)
    if found.experience >= 0:
        say(
            f"The earlier place: template {found.candidate}, experience {found.experience}, "
            "the nearest with that view in the pose cells"
        )
    for line in stored_lines(found):
        say(line)
    say(f"Written: {picture}")
    return 0


def evaluate_command(
    track: Annotated[Path, typer.Argument(metavar="TRACK", help="Folder of a run, or a TUM file.")],
    truth: Truth = None,
    align: Annotated[
        str | None,
        typer.Option(
            help="rigid, similarity or none; default: rigid, for one camera similarity first."
        ),
    ] = None,
    axes: Axes = None,
    track_axes: Annotated[
        str | None,
        typer.Option(metavar="AXES", help="The same of TRACK, if it is a TUM file."),
    ] = None,
    relations: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="True relative poses, t1 t2 x y z roll pitch yaw a line: Kuemmerle's metric.",
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="Compare the map with that of another run, by ICP."),
    ] = None,
    to: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="With --against: figure; default: TRACK/against.png."),
    ] = None,
) -> int:
    """Compare a trajectory with the ground truth, or a map with that of another run."""
    from neuroslam.runs.evaluate import compare_maps, evaluate, evaluate_relations

    if relations is not None:
        if truth is not None or against is not None:
            raise RunError("--relations: compares with relative poses alone; leave the others out")
        table = Table(title=printable(f"{track} and the relations of {relations}"))
        for column in ("relations", "number", "position, mean (m)", "heading, mean (°)"):
            table.add_column(column, justify="left" if column == "relations" else "right")
        compared = evaluate_relations(track, relations)
        names = ("relations", "number", "position_mean_m", "heading_mean_deg")
        summarise(track=track, relations=[dict(zip(names, row, strict=True)) for row in compared])
        for name, number, metres, degrees in compared:
            table.add_row(name, str(number), f"{metres:.4f}", f"{degrees:.3f}")
        say(table)
        return 0
    if against is None and to is not None:
        raise RunError("--out: is the figure of --against RUN; give both, or neither")
    if against is not None and truth is not None:
        raise RunError("--against: compares two maps, --truth a trajectory; give one of them")
    if against is not None:
        table = Table(
            title=printable(f"Experiences of {track} aligned with those of {against} by ICP")
        )
        for column in ("alignment", "RMSE (m)", "of the diagonal (%)", "rotation (°)", "scale"):
            table.add_column(column, justify="left" if column == "alignment" else "right")
        rows, figure = compare_maps(track, against, to)
        summarise(
            track=track, against=against, alignments=[row._asdict() for row in rows], written=figure
        )
        for row in rows:
            table.add_row(
                row.mode,
                f"{row.rmse_m:.4f}",
                f"{100.0 * row.of_diagonal:.3g}",
                f"{row.turn_deg:.1f}",
                f"{row.scale:.4f}",
            )
        say(table)
        say(f"Written: {figure}")
        return 0

    how = f", {align} alignment" if align else ""
    table = Table(title=printable(f"{track} and ground truth{how}"))
    for column in ("error", "rmse", "mean", "median", "max", "unit", "frames"):
        table.add_column(column, justify="left" if column in ("error", "unit") else "right")
    notes: list[str] = []
    mode = cast("AlignmentMode | None", align)  # looked at there
    errors = evaluate(track, truth, mode, notes.append, axes, track_axes)
    for name, found, unit in errors:
        table.add_row(name, *(f"{value:.4f}" for value in found[:4]), unit, str(found.n))
    summarise(
        track=track,
        errors=[{"error": name, **found._asdict(), "unit": unit} for name, found, unit in errors],
        notes=notes,
    )
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

    written = plot(out, to or out)
    summarise(path=out, written=written)
    for path in written:
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
    source: Annotated[
        bool,
        typer.Option(
            "--source",
            help="Open the recordings and maps that the folder names, for pictures of frames; not "
            "for a folder from somebody else.",
        ),
    ] = False,
) -> int:
    """Write one HTML page that explains a run, for any browser."""
    from neuroslam.report import write_report

    written = write_report(out, to, pictures_mb=pictures, source=source)
    summarise(path=out, written=written)
    say(f"Written: {written}")
    return 0
