"""Commands that make maps: run, resume, merge, demo."""

from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from neuroslam.cli.automatic import estimated
from neuroslam.cli.options import (
    ArenaOf,
    Assignments,
    Axes,
    BadFrame,
    Columns,
    ConfigFile,
    Confirm,
    Landmarks,
    LiveMap,
    NoTensorboard,
    Offset,
    OnBadFrame,
    Out,
    Overwrite,
    Record,
    RecordRate,
    RobotName,
    RunFolder,
    RunPreset,
    SaveEvery,
    Smooth,
    Source,
    Start,
    Stop,
    Truth,
    Units,
)
from neuroslam.cli.output import INTERRUPTED, REFUSED, USER_ERROR, complain, say, summarise
from neuroslam.cli.progress import show_frames
from neuroslam.cli.tables import Table, new_table
from neuroslam.errors import ConfigError, counted

if TYPE_CHECKING:
    from neuroslam.config import BrainConfig
    from neuroslam.runs.results import RunSummary


def run_command(
    source: Source,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder to write; not needed with --dry-run."),
    ] = None,
    preset: RunPreset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    maps: Annotated[
        list[Path] | None,
        typer.Option(
            "--map",
            metavar="OLD",
            help="Stored map to join, a run folder or brain file; repeatable. Without --preset or "
            "--config, its config is used.",
        ),
    ] = None,
    confirm: Confirm = None,
    landmarks: Landmarks = None,
    truth: Truth = None,
    axes: Axes = None,
    offset: Offset = None,
    columns: Columns = None,
    units: Units = None,
    arena: ArenaOf = None,
    smooth: Smooth = None,
    record: Record = None,
    rate: RecordRate = 20.0,
    start: Start = 0,
    stop: Stop = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    no_tensorboard: NoTensorboard = False,
    mcap: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write an MCAP file too, for Foxglove; needs the extra mcap."
        ),
    ] = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Open rerun's viewer; needs the extra rerun.")
    ] = False,
    rerun_save: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a recording for rerun, FILE.rrd.")
    ] = None,
    save_every: SaveEvery = 60.0,
    live: LiveMap = None,
    robot: RobotName = "",
    overwrite: Overwrite = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Print what would be read, and in which unit; write nothing."
        ),
    ] = False,
) -> int:
    """Map a SOURCE; write map, track and brain into a folder."""
    if out is None and not dry_run:
        raise ConfigError("Missing option '--out' / '-o': the folder to write")
    from neuroslam.brain import read_checkpoint
    from neuroslam.runs.activity import parse_record
    from neuroslam.runs.files import brain_file
    from neuroslam.runs.run import resolve_config, run

    if any(option is not None for option in (columns, units, arena, smooth)):
        from neuroslam.worlds.animal_tracks import track_spec

        source = track_spec(source, columns, units, arena, smooth)
    if record is not None:
        parse_record(record)  # before the source is read
    if confirm is not None:
        assignments = [*(assignments or ()), f"sessions.confirm={confirm}"]
    base = read_checkpoint(brain_file(maps[0]))[0] if maps else _config_of(live)
    given = tuple(assignments or ())
    settings = resolve_config(preset, config, given, base)
    if dry_run or out is None:
        named = preset or ("of the stored map" if maps and config is None else "")
        return _dry_run(source, out, settings, named, config, start, stop, offset, overwrite)
    if preset == "auto" or (preset is None and config is None and base is None):
        settings, preset = estimated(source, config, given, settings, preset, stop, offset)
    with show_frames(source) as (on_start, on_step):
        summary = run(
            source,
            out,
            settings,
            maps=maps or (),
            landmarks=landmarks,
            truth=truth,
            axes=axes,
            offset=offset,
            preset=preset or "",
            start=start,
            stop=stop,
            on_bad_frame=on_bad_frame.value,
            tensorboard=not no_tensorboard,
            mcap=mcap,
            rerun=rerun,
            rerun_save=rerun_save,
            overwrite=overwrite,
            on_step=on_step,
            on_start=on_start,
            save_every_s=save_every,
            record=False if record is None else parse_record(record) or True,
            record_rate_hz=rate,
            live=live,
            robot=robot,
        )
    return _report(summary, out, "run")


def _config_of(live: str | None) -> "BrainConfig | None":
    """Return the config of a shared map; ``None``: this robot is its first."""
    if live is None:
        return None
    from neuroslam.runs.live_map import config_of

    return config_of(live)


def _dry_run(
    source: str,
    out: Path | None,
    settings: "BrainConfig",
    preset: str,
    config: Path | None,
    start: int,
    stop: int | None,
    offset: str | None,
    overwrite: bool,
) -> int:
    """Print what a run would read; nothing is written."""
    from neuroslam.runs.clocks import resolve_offset
    from neuroslam.runs.files import require_free
    from neuroslam.runs.survey import survey, unit_and_measure
    from neuroslam.sensors.open import absolute_spec

    source, found_offset = resolve_offset(source, offset, settings)
    if out is not None:
        require_free(out, absolute_spec(source), overwrite)
    found = survey(source, settings, start=start, stop=stop)
    unit = unit_and_measure(found, settings)
    estimates = "images" in found.content and settings.view.features == "grey"
    if not preset and config is None:
        preset = "auto, estimated from the first laps" if estimates else "none, the defaults"
    preset = preset or "none, the config file"
    figures = found.to_dict() | {"source": source, "unit": unit, "preset": preset}
    summarise(**figures, cells=settings.cells, out=out)
    table = new_table("quantity", "value", title=f"{source}: what would be read", headed=False)
    for name, value in found.rows():
        table.add_row(name, value)
    table.add_row("unit of the map", unit)
    table.add_row("preset", preset)
    table.add_row("cells", "+".join(settings.cells))
    say(table)
    for note in (*found_offset, *found.notes):
        say(note)
    say("Nothing is written: --dry-run")
    return 0


def resume_command(
    out: RunFolder,
    stop: Stop = None,
    no_tensorboard: NoTensorboard = False,
    save_every: SaveEvery = 60.0,
) -> int:
    """Resume the run in DIR."""
    from neuroslam.runs.run import resume

    with show_frames(str(out)) as (on_start, on_step):
        summary = resume(
            out,
            stop=stop,
            tensorboard=not no_tensorboard,
            on_step=on_step,
            on_start=on_start,
            save_every_s=save_every,
        )
    if not summary.added and not summary.failure and not summary.interrupted:
        say("Nothing to do: the run has reached its end")
    return _report(summary, out, "resume")


def localise_command(
    stored: Annotated[
        Path, typer.Argument(metavar="MAP", help="Folder of a run, or its brain file.")
    ],
    source: Source,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE.csv", help="File of the poses to write.")
    ],
    start: Start = 0,
    stop: Stop = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier file.")
    ] = False,
) -> int:
    """Localise a SOURCE in a MAP, which is not changed: a pose and a confidence for each frame."""
    from neuroslam.runs.localise import localise

    summary = localise(
        stored,
        source,
        out,
        start=start,
        stop=stop,
        on_bad_frame=on_bad_frame.value,
        overwrite=overwrite,
    )
    summarise(map=stored, source=source, out=out, **vars(summary))
    frames = counted(summary.frames, "frame")
    if summary.first_found is None:
        say(f"Not found in the map in {frames}")
    else:
        again = f", lost {counted(summary.lost, 'time')} since" if summary.lost else ""
        share = 100 * summary.found / summary.frames
        say(f"Found at frame {summary.first_found}{again}; {share:.0f} % of {frames} have a pose")
    if summary.skipped:
        say(f"Skipped: {counted(len(summary.skipped), 'frame')}, the first: {summary.skipped[0]}")
    say(f"Written: {out}")
    return 0


def merge_command(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="A B [C ...]",
            help="Folders or brain files: the map merged into, and the sessions merged; the last "
            "can be resumed.",
        ),
    ],
    out: Out,
    confirm: Confirm = None,
    assignments: Assignments = None,
    overwrite: Overwrite = False,
) -> int:
    """Merge finished sessions; exit 3 if a merge is refused: nothing is written then.

    Of several, every pair is matched, and the best is merged first.
    """
    from neuroslam.errors import RunError
    from neuroslam.runs.merge import merge_runs
    from neuroslam.runs.reading import length_unit

    if len(maps) < 2:
        raise RunError("merge: one map is given; expected two or more")
    first, *between, last = maps
    summary, reports = merge_runs(
        first,
        last,
        out,
        between=between,
        confirm=confirm,
        assignments=assignments or (),
        overwrite=overwrite,
    )
    units = {length_unit(one) for one in maps}
    unit = units.pop() if len(units) == 1 else "m"
    for report in reports:
        _print_report(report.to_dict(), unit)
    summarise(merged=summary is not None, unit=unit, reports=[one.to_dict() for one in reports])
    if summary is None:
        return REFUSED
    summarise(out=out, **summary.to_dict())
    _print_not_joined(summary)
    say(f"Written: {out}")
    return 0


def demo_command(out: Out = Path("demo")) -> int:
    """Map a rendered world in two sessions and merge them into one map."""
    from neuroslam.runs.demo import demo

    with show_frames("world:corridor") as (on_start, on_step):
        rows = demo(out, on_step, on_start)
    summarise(out=out, figures=dict(rows), written=[out / "summary.png", out / "sessions.png"])
    table = Table(title="A corridor in two sessions, the second from an unknown start")
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for name, value in rows:
        table.add_row(name, value)
    say(table)
    say(f"Figures: {out / 'summary.png'}, {out / 'sessions.png'}")
    say(f"Runs: {out / 'first'}, {out / 'second'}")
    return 0


def _report(summary: "RunSummary", out: Path, command: str) -> int:
    from neuroslam.runs.inspect import shown_count
    from neuroslam.runs.reading import unit_of

    figures = summary.to_dict()
    summarise(out=out, unit=unit_of(summary.measured), failure=summary.failure, **figures)
    for note in summary.notes:
        say(note)
    for warning in summary.warnings:
        complain(command, f"warning: {warning}")
    for note in summary.skipped[:3]:
        complain(command, f"skipped: {note}")
    if len(summary.skipped) > 3:
        complain(command, f"skipped: {len(summary.skipped) - 3} more, see metrics.json")
    say(
        f"{counted(figures['frames'], 'frame')} at {figures['frames_per_s']:.0f} frames/s: "
        + ", ".join(
            counted(figures[f"{what}s".replace(" ", "_")], what)
            for what in ("template", "experience", "link", "loop closure")
        )
    )
    for note in summary.unused:
        say(note)
    if not figures["experiences"]:
        say(
            "No experiences: no image reaches the contrast view.min_contrast"
            if summary.pictures
            else "No experiences: the source has no images. Without a camera, use --preset slrb"
        )
    counts = [f"{name} {value}" for name, value in starmap(shown_count, summary.cells.items())]
    if counts:
        say(", ".join(counts))
    for report in (*summary.merges, *summary.refusals[:3]):
        _print_report(report, unit_of(summary.measured))
    _print_not_joined(summary)
    if summary.unplaced:
        say(
            f"{summary.unplaced} of {summary.frames} frames are on maps that were not joined; "
            "if the robot was not kidnapped: --set sessions.kidnapped=ignore"
        )
    for line in _accuracy_lines(summary):
        say(line)
    done = not summary.failure and not summary.interrupted
    say(f"Written: {out}" + (f"; next: neuroslam report {out}" if done else ""))
    if summary.failure:
        skips = summary.bad_frame and command == "run"
        hint = "; to leave out such frames: --on-bad-frame skip" if skips else ""
        complain(command, f"stopped early: {summary.failure}{hint}")
        return USER_ERROR
    if summary.interrupted:
        complain(command, f"interrupted; continue with: neuroslam resume {out}")
        return INTERRUPTED
    return 0


def _accuracy_lines(summary: "RunSummary") -> list[str]:
    """Return the errors against the truth: those with a free scale first, for one camera alone."""
    found = summary.accuracy
    if not found:
        return []
    known = int(found["frames_with_truth"])
    unit = "arbitrary unit" if summary.measured is False else "m"
    lines = [
        f"ATE (rigid): map {found['ate_rmse_m']:.3f} {unit}, "
        f"odometry alone {found['odometry_ate_rmse_m']:.3f} {unit}"
    ]
    if "ate_similarity_rmse_m" in found:
        lines.append(
            f"ATE (similarity): map {found['ate_similarity_rmse_m']:.3f} m, over "
            f"{counted(known, 'frame')} with truth"
        )
    if summary.measured is False:
        lines = [f"{lines[1]}; the scale is unknown (one camera)", lines[0]]
    if known < summary.frames:
        lines.append(f"{known:,} of {counted(summary.frames, 'frame')} have truth")
    return lines


def _print_not_joined(summary: "RunSummary") -> None:
    for stored in summary.not_joined[:3]:
        say(f"not joined: the map of {', '.join(stored['sessions'])}; {stored['reason']}")
    if len(summary.not_joined) > 3:
        say(f"not joined: {len(summary.not_joined) - 3} more maps, see metrics.json")


def _print_report(report: dict[str, Any], unit: str) -> None:
    from neuroslam.merging.report import MergeReport

    first, *others = MergeReport(**report).lines(unit)
    at = "" if report["at_frame"] is None else f"frame {report['at_frame']}: "
    say(f"{at}{first}")
    for line in others:
        say(f"  {line}")
