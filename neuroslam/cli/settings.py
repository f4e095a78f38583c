"""Commands about the parameters of a brain: tune, presets."""

from itertools import takewhile
from typing import Annotated

import typer

from neuroslam.cli.options import Assignments, ConfigFile, Offset, Out, Preset, Source, Stop
from neuroslam.cli.output import say
from neuroslam.cli.progress import show_stages
from neuroslam.cli.tables import new_table, shown


def tune_command(
    source: Source,
    out: Out,
    preset: Preset = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
    offset: Offset = None,
    stop: Stop = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier tuning in the folder.")
    ] = False,
) -> int:
    """Tune parameters from the images of a SOURCE, without ground truth; write a config."""
    from neuroslam.runs.clocks import resolve_offset
    from neuroslam.runs.run import resolve_config
    from neuroslam.tuning import tune

    settings = resolve_config(preset, config, tuple(assignments or ()))
    source, found = resolve_offset(source, offset, settings)
    for note in found:
        say(note)
    with show_stages("tune") as on_stage:
        tuning = tune(
            source,
            out,
            settings,
            stop=stop,
            overwrite=overwrite,
            on_stage=on_stage,
        )
    table = new_table("parameter", "before", "tuned", "reason")
    for key, (before, found, why) in tuning.changes.items():
        table.add_row(key, *("none" if v is None else shown(v) for v in (before, found)), why)
    say(table)
    for note in tuning.notes:
        say(note)
    for name, trial in (("before", tuning.before), ("tuned", tuning.after)):
        if trial is None:
            continue
        say(
            f"{name}: {trial.n_experiences} experiences, {trial.n_links} links, "
            f"inconsistency {shown(trial.inconsistency) or 'unknown'} (0: consistent, 1: useless)"
        )
    say(tuning.verdict)
    say(f"Written: {out}; next: neuroslam run {source} --config {out}/config.toml -o map")
    return 0


def presets_command() -> int:
    """List the presets and their purposes."""
    from neuroslam.config import preset_folder, preset_names

    table = new_table("preset", "purpose")
    for name in preset_names():
        lines = (preset_folder() / f"{name}.toml").read_text(encoding="utf-8").splitlines()
        about = takewhile(lambda line: line.startswith("#"), lines)
        table.add_row(name, " ".join(line.lstrip("# ") for line in about))
    say(table)
    return 0
