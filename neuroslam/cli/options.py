"""Arguments and options that several commands have."""

import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated

import typer

from neuroslam.cli.completion import complete_assignment, complete_preset
from neuroslam.cli.loading import load
from neuroslam.cli.output import reporting
from neuroslam.errors import ConfigError
from neuroslam.limits import MAX_MEMORY, budget_bytes


class OnBadFrame(StrEnum):
    """What to do with an unusable frame."""

    stop = "stop"
    skip = "skip"


Out = Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")]
MapFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="Brain file, or the folder of a run.")
]
RunFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")]
NoTensorboard = Annotated[bool, typer.Option("--no-tensorboard", help="Write no events/.")]
Stop = Annotated[int | None, typer.Option(help="Stop before this frame.")]
Confirm = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=1_000_000,
        help="Experiences that must agree before maps are joined; 1: the first match decides.",
    ),
]


Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="Video, folder or tar of images, image list, CSV of motion, npz trajectory, "
        "TUM, KITTI, EuRoC or donkeycar folder, ROS bag, camera:0, VIDEO+MOTION.csv, CSV of "
        "an animal's positions, arena:NAME or world:NAME.",
    ),
]
Landmarks = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Names and attributes of landmarks, walls, regions: CSV or TOML."
    ),
]
Truth = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Ground truth: a TUM file, or a CSV of time_s,x_m,y_m[,theta_rad]."
    ),
]
Axes = Annotated[
    str | None,
    typer.Option(
        metavar="AXES",
        help="Axes of the ground plane in the truth: robot (x, y; the default), camera (z, -x), or "
        "those that point ahead and left.",
    ),
]
Offset = Annotated[
    str | None,
    typer.Option(
        metavar="S",
        help="With VIDEO+MOTION.csv: seconds to add to the times of the motion; auto: by the turn "
        "rates.",
    ),
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="t=NAME,x=NAME,...",
        help="Columns of an animal's track: t, x, y and hd (head direction); default: usual names.",
    ),
]
Units = Annotated[
    str | None,
    typer.Option(
        metavar="UNITS",
        help="Units of an animal's track, as cm,deg,ms; "
        "default: those in the names of its columns, else m, rad, and s by the size of the steps.",
    ),
]
ArenaOf = Annotated[
    str | None,
    typer.Option(
        "--arena",
        metavar="NAME",
        help="Arena of an animal's track; hull: the outline of the track (the default); none.",
    ),
]
Smooth = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", min=0.0, help="Smooth the positions of an animal's track."),
]
Record = Annotated[
    str | None,
    typer.Option(
        metavar="cells[=POPULATION,...]",
        help="Record the activity of all cells over time, or of some populations.",
    ),
]
RecordRate = Annotated[
    float,
    typer.Option("--rate", metavar="HZ", min=1e-6, help="Samples a second of --record."),
]
Sources = Annotated[list[str], typer.Argument(metavar="SOURCE...", help="As for `run`.")]
Preset = Annotated[
    str | None,
    typer.Option(
        help="A preset; see `neuroslam presets`.",
        autocompletion=complete_preset,
    ),
]
RunPreset = Annotated[
    str | None,
    typer.Option(
        help="A preset, see `neuroslam presets`; default with images: auto, which estimates "
        "parameters from them.",
        autocompletion=complete_preset,
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option(help="TOML, or an OpenRatSLAM .ini/.txt; overrides the preset.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="E.g. view.threshold=0.04; overrides both; repeatable.",
        autocompletion=complete_assignment,
    ),
]
Start = Annotated[int, typer.Option(help="First frame.")]
BadFrame = Annotated[OnBadFrame, typer.Option(help="Stop at an unusable frame, or skip it.")]
SaveEvery = Annotated[
    float,
    typer.Option(
        metavar="SECONDS",
        min=0.0,
        help="Interval of saves during the run, for `resume`; 0: only at the end.",
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1, max=1024, help="Runs at a time; default: 1, on a cluster its number of processors."
    ),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="ADDRESS", help="Use a Ray cluster: HOST:PORT, auto, or local to start one"
    ),
]

Plugins = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin",
        metavar="FILE",
        help="Python file that registers populations; repeatable.",
    ),
]


MaxMemory = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Memory that files, archives, images and a config may take, as 2G; default: half of "
        "what is free.",
    ),
]


Quiet = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print no progress and no results; errors and warnings."),
]
Json = Annotated[
    bool,
    typer.Option(
        "--json", help="Print the results as one JSON object; all else goes to standard error."
    ),
]


def with_common_options(
    command: Callable[..., int], name: str, *, heavy: bool = True
) -> Callable[..., int]:
    """Add the options that all commands have; they take effect before the command runs.

    These are ``--plugin``, ``--max-memory``, ``--quiet`` and ``--json``.

    Args:
        command: The command.
        name: Its name on the command line.
        heavy: Whether it needs the library with torch, which is then loaded first.
    """

    @wraps(command)
    def run(
        *args: object,
        plugin: list[Path] | None = None,
        max_memory: str | None = None,
        quiet: bool = False,
        as_json: bool = False,
        **options: object,
    ) -> int:
        with reporting(name, quiet=quiet, as_json=as_json) as now, _budget(max_memory):
            if heavy:
                load()
            if plugin:
                from neuroslam.config.populations import load_plugin

                for file in plugin:
                    load_plugin(file)
            now.exit_code = command(*args, **options)
            return now.exit_code

    more = {"plugin": Plugins, "max_memory": MaxMemory, "quiet": Quiet, "as_json": Json}
    defaults = {"quiet": False, "as_json": False}
    signature = inspect.signature(command)
    last = [
        inspect.Parameter(
            key, inspect.Parameter.KEYWORD_ONLY, default=defaults.get(key), annotation=kind
        )
        for key, kind in more.items()
    ]
    parameters = [*signature.parameters.values(), *last]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, **more}
    return run


@contextmanager
def _budget(text: str | None) -> Iterator[None]:
    """Set the budget of this process, and of those that it starts."""
    before = os.environ.get(MAX_MEMORY)
    if text is not None:
        os.environ[MAX_MEMORY] = text
    try:
        budget_bytes()
    except ValueError as error:
        raise ConfigError(f"--max-memory: {error}") from None
    else:
        yield
    finally:
        if text is not None:
            os.environ.pop(MAX_MEMORY)
        if text is not None and before is not None:
            os.environ[MAX_MEMORY] = before


LiveMap = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="DIR",
        help="Shared map of a fleet, to which the robot offers its places while it maps; without "
        "--preset or --config, its config is used.",
    ),
]
RobotName = Annotated[
    str,
    typer.Option("--robot", metavar="NAME", help="Name of the robot there; default: its session."),
]
