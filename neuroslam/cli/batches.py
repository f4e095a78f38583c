"""Commands for many runs: sweep, fleet, experiment."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from neuroslam.cli.automatic import estimated_for_all, estimates
from neuroslam.cli.completion import complete_experiment
from neuroslam.cli.options import (
    Assignments,
    BadFrame,
    ConfigFile,
    Confirm,
    Jobs,
    OnBadFrame,
    Out,
    Overwrite,
    Preset,
    RayAddress,
    RunPreset,
    Sources,
    Start,
    Stop,
)
from neuroslam.cli.output import REFUSED, USER_ERROR, complain, say, summarise
from neuroslam.cli.progress import show_runs
from neuroslam.cli.tables import across, down
from neuroslam.errors import ConfigError, counted
from neuroslam.experiments import EXPERIMENTS
from neuroslam.workers import prepare_workers


def sweep_command(
    sources: Sources,
    out: Out,
    vary: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=A,B,C", help="E.g. view.threshold=0.03,0.05; repeatable."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=10_000,
            help="Runs of each combination, with seeds 0, 1, ... for noise and weights.",
        ),
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
    """Map sources with all combinations of values; exit 2 if a run failed."""
    prepare_workers(jobs, ray)
    from neuroslam.runs.sweep import counted_by_cells, sweep, varied

    values = {}
    if preset == "auto":
        values = {one: estimates(one, config, tuple(assignments or ()), stop) for one in sources}
    so_far = (0, 0)

    def note(done: int, total: int) -> None:
        nonlocal so_far
        so_far = done, total
        on_done("runs", done, total)

    with show_runs("sweep") as on_done:
        try:
            rows = sweep(
                sources,
                out,
                vary=vary or (),
                seeds=seeds,
                preset=preset,
                config=config,
                assignments=assignments or (),
                estimated=values,
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
                say(f"{done} of {counted(total, 'run')} ended: {out / 'sweep.csv'}")
            raise
    summarise(sources=sources, out=out, runs=rows)
    columns = ["templates", "experiences", "loop_closures", *counted_by_cells(rows), "ate_rmse_m"]
    if any(0 < row.get("frames_with_truth", 0) < row.get("frames", 0) for row in rows):
        columns.append("frames_with_truth")
    keys = [*varied(rows), *(key for key in columns if any(row.get(key) for row in rows))]
    say(down([{key: row.get(key, "") for key in keys} for row in rows], "sweep"))
    failed = [row for row in rows if row["error"]]
    for row in failed:
        complain("sweep", f"{row['run']}: {row['error']}")
    say_notes(out, [row["run"] for row in rows])
    say(f"Written: {out}")
    return USER_ERROR if failed else 0


def say_notes(out: Path, folders: Iterable[str]) -> None:
    """Print once each what the readers of the sources noted in several runs."""
    from neuroslam.errors import RunError
    from neuroslam.runs.reading import read_metrics

    printed: dict[str, None] = {}
    for folder in folders:
        with suppress(RunError):  # a run that failed
            printed |= dict.fromkeys(map(str, read_metrics(out / folder).get("notes", ())))
    for note in printed:
        say(note)


def fleet_command(
    sources: Sources,
    out: Out,
    preset: RunPreset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    confirm: Confirm = None,
    on_bad_frame: BadFrame = OnBadFrame.stop,
    jobs: Jobs = None,
    ray: RayAddress = None,
    live: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="New shared map to which all offer their places while they map; its fold is the "
            "merged map.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> int:
    """Map each SOURCE as one session, merge all; exit 3: some stay apart, 2: one failed."""
    prepare_workers(jobs, ray)
    from neuroslam.runs.fleet import fleet
    from neuroslam.runs.run import resolve_config

    if confirm is not None:
        assignments = [*(assignments or ()), f"sessions.confirm={confirm}"]
    given = tuple(assignments or ())
    settings = resolve_config(preset, config, given)
    if preset == "auto" or (preset is None and config is None):
        settings, preset = estimated_for_all(sources, config, given, settings, preset)
    with show_runs("fleet") as on_done:
        report = fleet(
            sources,
            out,
            settings,
            preset=preset or "",
            on_bad_frame=on_bad_frame.value,
            jobs=jobs,
            ray=ray,
            live=live,
            overwrite=overwrite,
            on_done=on_done,
        )
    summarise(out=out, **report.to_dict())
    for row in report.sessions:
        size = "failed"
        if "frames" in row:
            frames, experiences = row["frames"], row["experiences"]
            size = f"{counted(frames, 'frame')}, {counted(experiences, 'experience')}"
        say(f"session {row['session']}: {row['source']}: {size}")
    for row in report.tree:
        first, second = ("+".join(map(str, row[name])) for name in ("first", "second"))
        done = "merged" if row["merged"] else "not merged"
        say(f"level {row['level']}: {first} with {second}: {done}: {row['reason']}")
    if report.merged:
        error = report.merged.get("ate_rmse_m")
        say(
            f"one map of sessions {', '.join(map(str, report.merged['sessions']))}: "
            f"{counted(report.merged['experiences'], 'experience')}, "
            f"{counted(report.merged['links'], 'link')}"
            + ("" if error is None else f"; ATE (rigid) {error:.3f} m")
        )
    for part in report.apart:
        say(f"stays apart: sessions {', '.join(map(str, part['sessions']))}")
    say_notes(out, sorted(f"sessions/{path.name}" for path in out.glob("sessions/*")))
    say(f"Written: {out}")
    for row in report.failed:
        complain("fleet", f"session {row['session']}: {row['error']}")
    return USER_ERROR if report.failed else REFUSED if report.apart else 0


def live_command(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of the shared map of a fleet.")
    ],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RUN]...", help="Finished runs to offer first, of robots out of reach."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write the map into, as a run.")
    ] = None,
    watch: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", min=0.1, max=86_400.0,
            help="Fold again as often as robots offer places, with such pauses, until Ctrl-C.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> int:  # fmt: skip
    """Fold the places that robots offered to DIR into one map; exit 3: some are in quarantine."""
    from neuroslam.runs.live_map import LiveReport, fold_folder, offer_runs

    for row in offer_runs(folder, runs or ()):
        say(
            f"{row['run']}: {counted(row['places'], 'new place')} of {row['robot']}, "
            f"{row['bytes'] / 1e6:.2f} MB"
        )

    def show(report: LiveReport) -> None:
        say(f"{report.lines()[1]} ({report.seconds:.1f} s)")

    report = fold_folder(folder, out, overwrite=overwrite, on_fold=show, watch_s=watch)
    summarise(folder=folder, out=out, **report.to_dict())
    for line in report.lines():
        say(line)
    if out is not None:
        say(f"Written: {out}")
    return REFUSED if report.fold["quarantine"] else 0


def experiment_command(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="all, or one of: " + ", ".join(EXPERIMENTS),
            autocompletion=complete_experiment,
        ),
    ],
    out: Out,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of the recordings, if the experiment needs any."),
    ] = None,
    jobs: Jobs = None,
    ray: RayAddress = None,
    network: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="view-matching: add a network of torchvision, with the weights in FILE; "
            "repeatable.",
        ),
    ] = None,
    sequence: Annotated[
        str | None,
        typer.Option(
            metavar="NN",
            help="ssp-kitti: KITTI odometry sequence, 00 to 10; --data holds kitti_NN, or KITTI's "
            "own poses and sequences.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="all: shorter simulations with fewer animals."),
    ] = False,
) -> int:
    """Reproduce an experiment of a paper, or all of them with one page that compares them."""
    prepare_workers(jobs, ray)
    from neuroslam.experiments import run_all, run_experiment

    if name == "all":
        if jobs is not None or ray is not None or network or sequence is not None:
            raise ConfigError(
                "experiment all: takes --data and --quick; leave --jobs, --ray, --network and "
                "--sequence out, or run one experiment by its name"
            )
        lines = run_all(data, out, quick=quick, say=say)
        measured = sum(line.value is not None for line in lines)
        summarise(experiment=name, out=out, values=[line._asdict() for line in lines])
        say(f"{counted(len(lines), 'value')} of the papers, {measured} measured")
        say(f"Written: {out / 'reproduction.md'}")
        return 0
    if quick:
        raise ConfigError("--quick: belongs to experiment all; leave it out")
    networks = dict(_name_and_file(text) for text in network or [])
    rows = run_experiment(name, data, out, jobs, ray, networks, sequence)
    summarise(experiment=name, out=out, rows=rows)
    few = len({key for row in rows for key in row}) <= 9
    for table in [down(rows, name)] if few else across(rows, name):
        say(table)
    say(f"Written: {out}")
    return 0


def _name_and_file(text: str) -> tuple[str, Path]:
    name, equals, file = text.partition("=")
    if not (name and equals and file):
        raise ConfigError(
            f"--network {text!r}: expected NAME=FILE, e.g. resnet18.layer3=weights.pth"
        )
    return name, Path(file)
