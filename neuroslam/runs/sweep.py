"""Many runs side by side: sources, values of parameters and seeds, all with all, in one table."""

import csv
import io
import itertools
import json
import re
import tomllib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuroslam.config import BrainConfig
from neuroslam.config.populations import section_class
from neuroslam.errors import ConfigError, NeuroslamError, RunError
from neuroslam.figures.style import save
from neuroslam.figures.sweep import plot_sweep
from neuroslam.runs.files import OnBadFrame, require_free, write_text
from neuroslam.runs.parallel import outcomes
from neuroslam.runs.run import resolve_config, run
from neuroslam.sensors.open import absolute_spec, seeded_spec

SUMMARY = "sweep.json"

_SEEDS = {
    "place": ("grid_cells.seed",),
    "semantic": ("semantic.seed", "semantic.space.seed"),
}
"""Kind of a population -> parameters that are its seeds; of others, ``seed`` of their section."""


@dataclass(frozen=True)
class Trial:
    """One run of a sweep.

    Attributes:
        name: Its folder.
        source: What it maps.
        given: What tells it from the others: the source, what is varied, the seed.
        config: Of its brain.
    """

    name: str
    source: str
    given: dict[str, Any]
    config: BrainConfig


@dataclass(frozen=True)
class _Order:
    # What a process is asked to do: everything in it can be sent to another machine.
    trial: Trial
    out: Path
    preset: str
    start: int
    stop: int | None
    on_bad_frame: OnBadFrame


def parse_values(text: str) -> tuple[str, list[Any]]:
    """Read ``key=a,b,c``: values as in TOML, or else as text between commas.

    Raises:
        ConfigError: If there is no key, no value, or one twice.

    Example:
        >>> parse_values("view.threshold=0.03,0.05")
        ('view.threshold', [0.03, 0.05])
        >>> parse_values("cells=pose,pose+place"), parse_values("view.crop=[0,9,0,9],[1,8,1,8]")
        (('cells', ['pose', 'pose+place']), ('view.crop', [[0, 9, 0, 9], [1, 8, 1, 8]]))
    """
    key, _, raw = (part.strip() for part in text.partition("="))
    try:
        values = tomllib.loads(f"values = [{raw}]")["values"]
    except tomllib.TOMLDecodeError:
        values = [part.strip() for part in raw.split(",")]
    if not key or not values or "" in values:
        raise ConfigError(
            f"--vary {text!r}: expected key=a,b,c, e.g. view.threshold=0.03,0.05,0.08"
        )
    if len({_written(value) for value in values}) < len(values):
        raise ConfigError(f"--vary {text!r}: has a value twice")
    return key, values


def plan_sweep(
    sources: Sequence[str | Path],
    vary: Sequence[str] = (),
    seeds: int | None = None,
    preset: str | None = None,
    config: Path | None = None,
    assignments: Sequence[str] = (),
) -> list[Trial]:
    """List the runs of a sweep: each source with each of all values and each seed.

    Args:
        sources: As for :func:`neuroslam.runs.run.run`.
        vary: Texts like ``view.threshold=0.03,0.05``, laid over the config.
        seeds: So many runs of each, with seeds from 0: of the noise of worlds and arenas, and of
            the random weights of the cells; ``None``: one run, with the seeds as they are.
        preset: As for :func:`neuroslam.runs.run.resolve_config`, and so the next two.
        config: A config file.
        assignments: Single values.

    Raises:
        ConfigError: If a value cannot be used.
        SourceError: If a source has a seed, and there are ``seeds``.
        RunError: If nothing is varied, or ``seeds`` would change nothing.

    Example:
        >>> plan = plan_sweep(["world:town"], ["view.threshold=0.03,0.05"], seeds=2)
        >>> [trial.name for trial in plan]
        ['1-threshold-0.03-seed-0', '2-threshold-0.03-seed-1',
         '3-threshold-0.05-seed-0', '4-threshold-0.05-seed-1']
        >>> plan[1].source
        'world:town?seed=1'
    """
    varied = dict(map(parse_values, vary))
    if len(varied) < len(vary):
        raise ConfigError("--vary: the same key is given twice; put all its values into one")
    if len({str(source) for source in sources}) < len(sources):
        raise RunError("a source is given twice; give each once")
    if len(sources) < 2 and not varied and seeds is None:
        raise RunError("nothing is varied; give several sources, --vary or --seeds")
    if seeds is not None and seeds < 1:
        raise RunError(f"seeds is {seeds}; expected 1 or more")
    ways = list(itertools.product(sources, *varied.values(), range(seeds) if seeds else (None,)))
    return [
        _trial(number, len(ways), way, tuple(varied), len(sources) > 1, preset, config, assignments)
        for number, way in enumerate(ways, start=1)
    ]


def _trial(
    number: int,
    total: int,
    way: tuple[Any, ...],
    keys: tuple[str, ...],
    many_sources: bool,
    preset: str | None,
    config: Path | None,
    assignments: Sequence[str],
) -> Trial:
    given, *values, seed = way
    source = absolute_spec(str(given))
    texts = [*assignments, *(f"{key}={_written(v)}" for key, v in zip(keys, values, strict=True))]
    try:
        settings = resolve_config(
            preset, config, tuple(texts), option="--vary" if keys else "--set"
        )
    except ConfigError:
        resolve_config(preset, config, tuple(assignments))  # a mistake in these is told as theirs
        raise
    if seed is not None:
        over = [key for kind in settings.cells for key in _seeds_of(kind) if key not in keys]
        settings = resolve_config(None, None, tuple(f"{key}={seed}" for key in over), settings)
        seeded = seeded_spec(source, seed)
        if seeded == source and not over:
            raise RunError(
                f"--seeds: nothing is random in {given} with cells {'+'.join(settings.cells)}; "
                "leave --seeds out"
            )
        source = seeded
    told: dict[str, Any] = {"source": str(given)}
    told |= dict(zip(keys, values, strict=True))
    words = [Path(str(given)).name[:24]] if many_sources else []
    for key, value in zip(keys, values, strict=True):
        words += [key.rpartition(".")[2], _written(value)]
    if seed is not None:
        told["seed"] = seed
        words += ["seed", str(seed)]
    name = re.sub(r"[^\w.+]+", "-", "-".join(words)).strip("-.")[:80]
    return Trial(f"{number:0{len(str(total))}d}-{name}", source, told, settings)


def _seeds_of(kind: str) -> tuple[str, ...]:
    """Name the seeds of a population."""
    section = section_class(kind)
    if section is not None and "seed" in section.model_fields:
        return (f"{kind}.seed",)
    return _SEEDS.get(kind, ())


def sweep(
    sources: Sequence[str | Path],
    out: str | Path,
    *,
    vary: Sequence[str] = (),
    seeds: int | None = None,
    preset: str | None = None,
    config: Path | None = None,
    assignments: Sequence[str] = (),
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    jobs: int | None = None,
    ray: str | None = None,
    overwrite: bool = False,
    on_done: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Run everything with everything, and write a summary: ``sweep.csv``, ``.json`` and ``.png``.

    Each run is a folder of ``out`` like any other run's, but without ``events/``. One that fails
    does not stop the others.

    Args:
        sources: As for :func:`plan_sweep`, and so the next five.
        out: Folder to write; made if missing. With Ray, on a disk that all machines share.
        vary: What is varied.
        seeds: How many seeds.
        preset: Name of a preset.
        config: A config file.
        assignments: Single values.
        start: First frame of each source.
        stop: Frame to stop before; the end if not given.
        on_bad_frame: As for :func:`neuroslam.runs.run.run`.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.
        overwrite: Replace the runs and the summary of an earlier sweep.
        on_done: Called after each run with how many are done, and how many there are.

    Returns:
        A row for each run, in order: what it was given, its figures, and ``error``, empty where it
        went well.

    Raises:
        NeuroslamError: If the sweep cannot be begun: as for :func:`plan_sweep`, or ``out`` holds
            one already or cannot be written, or Ray is not to be reached.
        KeyboardInterrupt: If it is interrupted; the summary tells what was done until then.
    """
    out = Path(out).resolve()
    trials = plan_sweep(sources, vary, seeds, preset, config, assignments)
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    claim(out, SUMMARY, overwrite)
    for trial in trials:
        require_free(out / trial.name, trial.source, overwrite)
    orders = [_Order(trial, out, preset or "", start, stop, on_bad_frame) for trial in trials]
    found: dict[int, dict[str, Any]] = {}
    try:
        with closing(outcomes(_map, orders, jobs, ray)) as each:
            for number, outcome in each:
                found[number] = told(outcome, out / trials[number].name)
                if on_done is not None:
                    on_done(len(found), len(trials))
    finally:
        rows = [
            {"run": trial.name} | trial.given | found.get(k, {"error": "interrupted"})
            for k, trial in enumerate(trials)
        ]
        if found:
            _write(out, rows, [key for key in given(rows) if key not in ("run", "seed")])
    return rows


def claim(out: Path, summary: str, overwrite: bool) -> None:
    """Make the folder of many runs, unless it holds some already.

    Raises:
        RunError: If it does, is a file or cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder to write")
    if (out / summary).exists() and not overwrite:
        raise RunError(f"{out}: holds a {summary} already; take another folder or --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None


def _map(order: _Order) -> dict[str, Any]:
    trial = order.trial
    given: dict[str, Any] = {"preset": order.preset, "on_bad_frame": order.on_bad_frame}
    given |= {"start": order.start, "stop": order.stop}
    return run_one(trial.source, order.out / trial.name, trial.config, **given)


def run_one(source: str, folder: Path, config: BrainConfig, **given: Any) -> dict[str, Any]:  # noqa: ANN401
    """Make one run of many; arguments are those of :func:`neuroslam.runs.run.run`.

    Returns:
        Its figures, and ``error``, empty where it went well.

    Raises:
        KeyboardInterrupt: If it is interrupted.
    """
    # Whether it may overwrite was asked before; a process that died has left something.
    summary = run(source, folder, config, tensorboard=False, overwrite=True, **given)
    if summary.interrupted:
        raise KeyboardInterrupt
    return summary.to_dict() | {"error": summary.failure}


def told(outcome: dict[str, Any] | NeuroslamError, folder: Path) -> dict[str, Any]:
    """Keep the numbers of a run's summary, and say what went wrong."""
    if isinstance(outcome, NeuroslamError):
        return {"error": str(outcome)}
    if not folder.is_dir():
        outcome["error"] = f"{folder}: is not here; expected a disk that all machines share"
    return {key: v for key, v in outcome.items() if isinstance(v, int | float | str)}


def given(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the keys that tell the runs of a sweep from each other; ``run`` if none does.

    Example:
        >>> given([{"run": "1", "source": "a", "seed": 0}, {"run": "2", "source": "a", "seed": 1}])
        ['seed']
    """
    keys = list(itertools.takewhile(lambda key: key not in ("frames", "error"), rows[0]))[1:]
    return [key for key in keys if len({str(row[key]) for row in rows}) > 1] or ["run"]


def _write(out: Path, rows: list[dict[str, Any]], varied: list[str]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row if key != "error"))
    text = io.StringIO()
    table = csv.DictWriter(text, [*columns, "error"], lineterminator="\n")
    table.writeheader()
    for row in rows:
        table.writerow({key: _written(value) for key, value in row.items()})
    summary = {"varied": varied, "runs": rows}
    try:
        write_text(out / "sweep.csv", text.getvalue())
        write_text(out / SUMMARY, json.dumps(summary, indent=2, ensure_ascii=False) + "\n")
        if any("experiences" in row for row in rows):
            save(plot_sweep(rows, varied), out / "sweep.png")
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None


def _written(value: object) -> str:
    """Write a value as ``--set`` reads it."""
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)
