"""Sweeps: runs over all combinations of sources, parameter values and seeds, in one table."""

import csv
import io
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuroslam.config import BrainConfig
from neuroslam.config.populations import section_class
from neuroslam.errors import ConfigError, NeuroslamError, RunError, WriteError, csv_text
from neuroslam.figures.style import save
from neuroslam.figures.sweep import plot_sweep
from neuroslam.limits import parse_toml
from neuroslam.runs.files import OnBadFrame, require_free, write_text
from neuroslam.runs.parallel import outcomes
from neuroslam.runs.run import resolve_config, run
from neuroslam.runs.saves import Folder, writing
from neuroslam.sensors.open import absolute_spec, seeded_spec
from neuroslam.state.answers import RUN_FIGURES

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
        name: Name of its folder.
        source: Source that it maps.
        varied: What distinguishes it from other trials: source, varied parameters, seed.
        config: Config of its brain.
    """

    name: str
    source: str
    varied: dict[str, Any]
    config: BrainConfig


@dataclass(frozen=True)
class _Order:
    # Arguments of one run: everything in it can be sent to another machine.
    trial: Trial
    out: Path
    preset: str
    start: int
    stop: int | None
    on_bad_frame: OnBadFrame


def parse_values(text: str) -> tuple[str, list[Any]]:
    """Parse ``key=a,b,c``: values in TOML syntax, else text separated by commas.

    Raises:
        ConfigError: If the key or a value is missing, or a value occurs twice.

    Example:
        >>> parse_values("view.threshold=0.03,0.05")
        ('view.threshold', [0.03, 0.05])
        >>> parse_values("cells=pose,pose+place"), parse_values("view.crop=[0,9,0,9],[1,8,1,8]")
        (('cells', ['pose', 'pose+place']), ('view.crop', [[0, 9, 0, 9], [1, 8, 1, 8]]))
    """
    key, _, raw = (part.strip() for part in text.partition("="))
    try:
        values = parse_toml(f"values = [{raw}]")["values"]
    except ValueError:
        values = [part.strip() for part in raw.split(",")]
    if not key or not values or "" in values:
        raise ConfigError(
            f"--vary {text!r}: expected key=a,b,c, e.g. view.threshold=0.03,0.05,0.08"
        )
    if len({_written(value) for value in values}) < len(values):
        raise ConfigError(f"--vary {text!r}: a value occurs twice; give each value once")
    return key, values


def plan_sweep(
    sources: Sequence[str | Path],
    vary: Sequence[str] = (),
    seeds: int | None = None,
    preset: str | None = None,
    config: Path | None = None,
    assignments: Sequence[str] = (),
    estimated: Mapping[str, Any] | None = None,
) -> list[Trial]:
    """List the runs of a sweep: every combination of source, parameter values and seed.

    Args:
        sources: As for :func:`neuroslam.runs.run.run`.
        vary: Assignments like ``view.threshold=0.03,0.05``, which override the config.
        seeds: Runs of each combination, with seeds from 0, for the noise of worlds and arenas and
            the random weights of cells; ``None``: one run with the configured seeds.
        preset: As for :func:`neuroslam.runs.run.resolve_config`, like the next two.
        config: A config file.
        assignments: Single values.
        estimated: Sources -> what is estimated from them, which overrides the preset alone.

    Raises:
        ConfigError: If a value is invalid.
        SourceError: If a source names a seed and ``seeds`` is given.
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
        raise ConfigError("--vary: a key is given twice; give all its values in one --vary")
    if len({str(source) for source in sources}) < len(sources):
        raise RunError("a source is given twice; give each once")
    if len(sources) < 2 and not varied and seeds is None:
        raise RunError("nothing is varied; give several sources, --vary or --seeds")
    if seeds is not None and seeds < 1:
        raise RunError(f"seeds is {seeds}; expected 1 or more")
    combinations = list(
        itertools.product(sources, *varied.values(), range(seeds) if seeds else (None,))
    )
    keys, total, many = tuple(varied), len(combinations), len(sources) > 1
    return [
        _trial(number, total, combination, keys, many, preset, config, assignments, estimated or {})
        for number, combination in enumerate(combinations, start=1)
    ]


def _trial(
    number: int,
    total: int,
    combination: tuple[Any, ...],
    keys: tuple[str, ...],
    many_sources: bool,
    preset: str | None,
    config: Path | None,
    assignments: Sequence[str],
    estimated: Mapping[str, Any],
) -> Trial:
    name, *values, seed = combination
    source = absolute_spec(str(name))
    texts = [*assignments, *(f"{key}={_written(v)}" for key, v in zip(keys, values, strict=True))]
    try:
        settings = resolve_config(
            preset, config, tuple(texts), option="--vary" if keys else "--set",
            estimated=estimated.get(str(name)),
        )  # fmt: skip
    except ConfigError:
        resolve_config(
            preset, config, tuple(assignments)
        )  # an error in these is reported as theirs
        raise
    if seed is not None:
        over = [key for kind in settings.cells for key in _seeds_of(kind) if key not in keys]
        settings = resolve_config(None, None, tuple(f"{key}={seed}" for key in over), settings)
        seeded = seeded_spec(source, seed)
        if seeded == source and not over:
            raise RunError(
                f"--seeds: nothing is random in {name} with cells {'+'.join(settings.cells)}; "
                "omit --seeds"
            )
        source = seeded
    varied: dict[str, Any] = {"source": str(name)}
    varied |= dict(zip(keys, values, strict=True))
    words = [Path(str(name)).name[:24]] if many_sources else []
    for key, value in zip(keys, values, strict=True):
        words += [key.rpartition(".")[2], _written(value)]
    if seed is not None:
        varied["seed"] = seed
        words += ["seed", str(seed)]
    folder = re.sub(r"[^\w.+]+", "-", "-".join(words)).strip("-.")[:80]
    return Trial(f"{number:0{len(str(total))}d}-{folder}", source, varied, settings)


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
    estimated: Mapping[str, Any] | None = None,
    start: int = 0,
    stop: int | None = None,
    on_bad_frame: OnBadFrame = "stop",
    jobs: int | None = None,
    ray: str | None = None,
    overwrite: bool = False,
    on_done: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Run all combinations, and write a summary: ``sweep.csv``, ``.json`` and ``.png``.

    Each run has a folder in ``out`` with the files of a run, without ``events/``. A run that fails
    does not stop the others.

    Args:
        sources: As for :func:`plan_sweep`, like the next six but ``out``.
        out: Folder to write; created if missing. With Ray, on a disk shared by all machines.
        vary: Parameters to vary, and their values.
        seeds: Number of seeds.
        preset: Name of a preset.
        config: A config file.
        assignments: Single values.
        estimated: What is estimated from the sources.
        start: First frame of each source.
        stop: Frame to stop before; default: the end.
        on_bad_frame: As for :func:`neuroslam.runs.run.run`.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.
        overwrite: Replace the runs and the summary of an earlier sweep.
        on_done: Called after each run with the number done and the total.

    Returns:
        A row for each run, in order: what is varied, its figures, and ``error``, empty on
        success.

    Raises:
        NeuroslamError: If the sweep cannot start: as for :func:`plan_sweep`, or ``out`` holds a
            sweep already, or Ray cannot be reached.
        WriteError: If ``out``, or a run in it, cannot be written.
        KeyboardInterrupt: If it is interrupted; the summary holds the runs that ended before.
    """
    out = Path(out).resolve()
    trials = plan_sweep(sources, vary, seeds, preset, config, assignments, estimated)
    if start < 0 or (stop is not None and stop <= start):
        raise RunError(f"start is {start}, stop is {stop}; expected 0 <= start < stop")
    with claimed(out, SUMMARY, overwrite) as (folder, inside):
        for trial in trials:
            require_free(inside / trial.name, trial.source, overwrite)
        orders = [
            _Order(trial, inside, preset or "", start, stop, on_bad_frame) for trial in trials
        ]
        found: dict[int, dict[str, Any]] = {}
        try:
            with closing(outcomes(_map, orders, jobs, ray)) as each:
                for number, outcome in each:
                    if isinstance(outcome, WriteError):  # a full disk fails all that follow
                        raise outcome
                    found[number] = figures(outcome, inside / trials[number].name)
                    if on_done is not None:
                        on_done(len(found), len(trials))
        except WriteError:
            found.clear()  # an earlier sweep stays
            raise
        finally:
            rows = [
                {"run": trial.name} | trial.varied | found.get(k, {"error": "interrupted"})
                for k, trial in enumerate(trials)
            ]
            if found:
                keys = [key for key in varied(rows) if key not in ("run", "seed")]
                _write(folder.staged, rows, keys)
                folder.commit(("sweep.png",))
    return rows


@contextmanager
def claimed(out: Path, summary: str, overwrite: bool) -> Iterator[tuple[Folder, Path]]:
    """Lock the folder of many runs.

    Yields:
        The folder, and where the runs are made: in it, or beside those of an earlier summary until
        the next save replaces them.

    Raises:
        RunError: If it holds a summary already, is a file, cannot be written or is in use.
    """
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder")
    with writing(out) as folder:
        earlier = (out / summary).exists()
        if earlier and not overwrite:
            raise RunError(
                f"{out}: holds a {summary} already; choose another folder or use --overwrite"
            )
        yield folder, folder.staged if earlier else out


def _map(order: _Order) -> dict[str, Any]:
    trial = order.trial
    arguments: dict[str, Any] = {"preset": order.preset, "on_bad_frame": order.on_bad_frame}
    arguments |= {"start": order.start, "stop": order.stop}
    return run_one(trial.source, order.out / trial.name, trial.config, **arguments)


def run_one(source: str, folder: Path, config: BrainConfig, **arguments: Any) -> dict[str, Any]:  # noqa: ANN401
    """Run one of many; arguments are those of :func:`neuroslam.runs.run.run`.

    Returns:
        Its figures, and ``error``, empty on success.

    Raises:
        KeyboardInterrupt: If the run is interrupted.
    """
    # Checked before that it may overwrite; a process that died can have left files.
    summary = run(source, folder, config, tensorboard=False, overwrite=True, **arguments)
    if summary.interrupted:
        raise KeyboardInterrupt
    return summary.to_dict() | {"error": summary.failure}


def figures(outcome: dict[str, Any] | NeuroslamError, folder: Path) -> dict[str, Any]:
    """Return the numbers of a run's summary, and ``error``."""
    if isinstance(outcome, NeuroslamError):
        return {"error": str(outcome)}
    if not folder.is_dir():
        outcome["error"] = (
            f"{folder}: not found here; expected --out on a disk shared by all machines"
        )
    return {key: v for key, v in outcome.items() if isinstance(v, int | float | str)}


def varied(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the keys whose values differ between the runs of a sweep; ``run`` if none does.

    Example:
        >>> rows = [{"run": "1", "source": "a", "seed": 0}, {"run": "2", "source": "a", "seed": 1}]
        >>> varied(rows)
        ['seed']
    """
    keys = list(itertools.takewhile(lambda key: key not in ("frames", "error"), rows[0]))[1:]
    return [key for key in keys if len({str(row[key]) for row in rows}) > 1] or ["run"]


def counted_by_cells(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the names of what the populations of the runs of a sweep count.

    Example:
        >>> row = {"run": "1", "seed": 0, "frames": 9, "links": 2, "visits": 3, "error": ""}
        >>> counted_by_cells([row])
        ['visits']
    """
    names = dict.fromkeys(
        key for row in rows for key in itertools.dropwhile(lambda key: key != "frames", row)
    )
    return [name for name in names if name not in RUN_FIGURES and name != "error"]


def _write(out: Path, rows: list[dict[str, Any]], keys: list[str]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row if key != "error"))
    text = io.StringIO()
    table = csv.DictWriter(text, [*columns, "error"], lineterminator="\n")
    table.writeheader()
    for row in rows:
        table.writerow({key: csv_text(_written(value)) for key, value in row.items()})
    summary = {"varied": keys, "runs": rows}
    write_text(out / "sweep.csv", text.getvalue())
    write_text(out / SUMMARY, json.dumps(summary, indent=2, ensure_ascii=False) + "\n")
    if any("experiences" in row for row in rows):
        save(plot_sweep(rows, keys), out / "sweep.png")


def _written(value: object) -> str:
    """Format a value as ``--set`` reads it."""
    if isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)
