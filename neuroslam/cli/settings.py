"""Commands about the parameters of a brain: tune, presets."""

import math
from itertools import takewhile
from typing import Annotated

import typer

from neuroslam.cli.options import Assignments, ConfigFile, Offset, Out, Preset, Source, Stop
from neuroslam.cli.output import say, summarise
from neuroslam.cli.progress import show_stages
from neuroslam.cli.tables import new_table


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
    """Compare configs for the images of a SOURCE, without ground truth; write the best known.

    The estimates of the preset auto are compared with other configs, and with that of --preset or
    --config; what --set sets holds for all.
    """
    from neuroslam.runs.clocks import resolve_offset
    from neuroslam.runs.run import resolve_config
    from neuroslam.tuning import tune

    given = tuple(assignments or ())
    settings = resolve_config(preset, config, given)
    source, found = resolve_offset(source, offset, settings)
    for note in found:
        say(note)
    with show_stages("tune") as on_stage:
        tuning = tune(
            source,
            out,
            settings if preset not in (None, "auto") or config is not None else None,
            assignments=given,
            stop=stop,
            overwrite=overwrite,
            on_stage=on_stage,
        )
    summarise(source=source, out=out, **tuning.to_dict())
    for note in tuning.notes:
        say(note)
    table = new_table(
        "candidate", "frames on the map", "error", "wrong loop links", "growth", "experiences",
        "refused",
    )  # fmt: skip
    for one in tuning.trials:
        shares = (one.on_map, one.error, one.wrong_links, one.growth)
        percent = ("unknown" if math.isnan(x) else f"{100 * x:.1f} %" for x in shares)
        table.add_row(one.name, *percent, str(one.experiences), one.refused)
    say(table)
    say(tuning.verdict)
    say(f"Written: {out}; next: neuroslam run {source} --config {out}/config.toml -o map")
    return 0


def presets_command() -> int:
    """List the presets and their purposes."""
    from neuroslam.config import preset_folder, preset_names

    table = new_table("preset", "purpose")
    presets: dict[str, str] = {}
    for name in preset_names():
        lines = (preset_folder() / f"{name}.toml").read_text(encoding="utf-8").splitlines()
        about = takewhile(lambda line: line.startswith("#"), lines)
        presets[name] = " ".join(line.lstrip("# ") for line in about)
        table.add_row(name, presets[name])
    summarise(presets=presets)
    say(table)
    return 0
