"""Compare candidates for a video by their maps of its later half, and write the best known."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from neuroslam.config import BrainConfig, to_toml
from neuroslam.errors import RunError, counted
from neuroslam.figures.style import save
from neuroslam.figures.tuning import plot_tuning
from neuroslam.runs.files import write_text
from neuroslam.runs.run import resolve_config
from neuroslam.runs.saves import writing
from neuroslam.sensors import Source, open_source
from neuroslam.state.registry import leading_class
from neuroslam.threads import limit_threads
from neuroslam.tuning.auto import SHARE, estimate
from neuroslam.tuning.candidates import automatic, candidates, field_by_revisits
from neuroslam.tuning.drive import Drive, key_frames, read_drive
from neuroslam.tuning.motion import FieldOfView
from neuroslam.tuning.revisits import Revisits, differences_of, find_revisits, fitting
from neuroslam.tuning.score import Mapped, Trial, better_by, cost, given_up, refuse, score
from neuroslam.view.features import view_encoder
from neuroslam.view.preprocess import encode

MIN_REVISITS = 30
"""Fewest revisits for a comparison: below, a drive holds too little information about its loops."""


@dataclass
class Tuning:
    """The result of tuning.

    Attributes:
        config: The config written.
        revisits: Pairs of key frames that show the same place.
        keys: Positions of the key frames among the frames with a picture.
        chosen: Name of the candidate whose config it is.
        verdict: Why that one, in words.
        changes: Key -> value before and value written, for each that differs.
        notes: Messages for the user.
        trials: The candidates' maps, ``auto`` first.
        motion: The field of view by revisits; ``None`` where they do not determine it.
        differences: Of templates: neighbours in time, revisits, and different places.
    """

    config: BrainConfig
    revisits: Revisits
    keys: np.ndarray
    chosen: str = "auto"
    verdict: str = ""
    changes: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    trials: list[Trial] = field(default_factory=list)
    motion: FieldOfView | None = None
    differences: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``tune.json``."""
        return {
            "chosen": self.chosen,
            "verdict": self.verdict,
            "revisits": len(self.revisits.same),
            "key_frames": len(self.keys),
            "changes": [
                {"key": key, "before": before, "found": found}
                for key, (before, found) in self.changes.items()
            ],
            "notes": self.notes,
            "candidates": [trial.to_dict() for trial in self.trials],
        }


def tune(
    source: str | Path,
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    assignments: Sequence[str] = (),
    stop: int | None = None,
    overwrite: bool = False,
    on_stage: Callable[[str], None] | None = None,
    features: nn.Module | None = None,
) -> Tuning:
    """Compare the estimates of the preset ``auto`` with other configs on the whole drive.

    Tuning needs no ground truth. Each candidate maps the drive as a run would, kidnappings
    included; the maps are compared on the later half of the drive with revisits that come from
    sequences of pictures. A candidate replaces ``auto`` only if it is clearly better by one figure
    and worse by none, see :data:`neuroslam.tuning.score.FIGURES`.

    Args:
        source: Any source with pictures that :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write: ``config.toml``, ``tune.json``, ``tune.png``.
        config: A config to compare too; it gives all that is not tuned. ``None``: the defaults,
            which are no candidate.
        assignments: Settings that hold for every candidate, like ``map.loops=5``.
        stop: Frame to stop before; tuning reads at most 12 000 frames.
        overwrite: Replace an earlier tuning in ``out``.
        on_stage: Called with the name of each stage when it begins.
        features: Network that makes views, where ``config.view.features`` is ``"module"``. Of such
            views only the threshold is tuned.

    Raises:
        SourceError: If the source cannot be read, or has fewer than a hundred pictures.
        RunError: If the source is live, the brain has no pose cells, or ``out`` cannot be written.
    """
    out, start = Path(out), config or BrainConfig()
    if assignments:
        start = resolve_config(assignments=tuple(assignments), base=config)
    if not leading_class(start).needs_views:
        raise RunError(
            f"cells are {'+'.join(start.cells)}, expected pose: tuning is for brains that match "
            "views"
        )
    if stop is not None and stop < 1:
        raise RunError(f"stop is {stop}; expected 1 or more")
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder to write")
    _require_free(out, overwrite)
    opened = open_source(source, start.frame_rate_hz, start.view.grey)
    if opened.live:
        raise RunError(
            f"{opened.name}: is live; tuning reads its source several times, so tune on a recording"
        )
    report = on_stage or (lambda stage: None)
    with limit_threads():
        tuning = _tune(opened, start, config is not None, assignments, stop, report, features)
        tuning.notes[:0] = opened.notes
        figure = plot_tuning(tuning, opened.name)
    with writing(out) as folder:
        _require_free(out, overwrite)  # another process may have been faster
        save(figure, folder.staged / "tune.png")
        write_text(folder.staged / "tune.json", json.dumps(tuning.to_dict(), indent=2) + "\n")
        write_text(folder.staged / "config.toml", to_toml(tuning.config))
        folder.commit()
    return tuning


def _require_free(out: Path, overwrite: bool) -> None:
    if (out / "config.toml").exists() and not overwrite:
        raise RunError(f"{out}: holds a config.toml already; take another folder or --overwrite")


def _tune(
    source: Source,
    start: BrainConfig,
    given: bool,
    assignments: Sequence[str],
    stop: int | None,
    report: Callable[[str], None],
    features: nn.Module | None,
) -> Tuning:
    report("reading")
    plain = automatic(start, assignments)
    network = plain.view.features != "grey"
    encoder = view_encoder(plain.view, features) if network else None
    drive = read_drive(source, stop, encoder, start.view.grey)
    keys = key_frames(drive)
    report("finding revisits")
    revisits = find_revisits(drive.pictures[keys])
    report("estimating from the first laps")
    grey = plain.model_copy(update={"view": automatic(BrainConfig()).view})
    estimates = estimate(source, plain if encoder is None else grey, stop)
    tuning = Tuning(start, revisits, keys, notes=list(estimates.notes))
    tuning.motion = field_by_revisits(drive, keys, revisits)
    found = candidates(start, given, assignments, estimates, drive, tuning.motion)
    if encoder is not None:
        found = _for_network(found, drive, tuning, assignments)
    if len(revisits.same) < MIN_REVISITS:
        found = {"auto": found["auto"]}
        tuning.notes.append(
            f"{len(revisits.same)} of {len(keys)} key frames seem to revisit a place, of at least "
            f"{MIN_REVISITS} needed to compare maps: drive the same route twice"
        )
    if drive.unusable:
        tuning.notes.append(f"{counted(drive.unusable, 'frame')} could not be used, left out")
    indices = np.array([drive.frames[key].index for key in keys])
    last, sizes = drive.frames[-1].index + 1, None
    for name, config in found.items():
        report(f"mapping with {name}")
        frames = source.frames(stop=last, on_bad_frame=lambda fault: None)
        mapped = Mapped(config, frames, drive.views, sizes)
        if mapped.stopped:
            tuning.trials.append(given_up(name, config, mapped))
            continue
        tuning.trials.append(score(name, config, mapped, indices, revisits))
        if name == "auto" and not refuse(tuning.trials)[0].refused:
            sizes = mapped.sizes
    tuning.trials = refuse(tuning.trials)
    best, tuning.verdict = choose(tuning.trials)
    tuning.config, tuning.chosen = best.config, best.name
    tuning.changes = _changes(start, best.config)
    tuning.differences = _differences(drive, tuning)
    return tuning


def choose(trials: Sequence[Trial]) -> tuple[Trial, str]:
    """Return the candidate to write, and why.

    Args:
        trials: After :func:`~neuroslam.tuning.score.refuse`; the first is what a run would do.
    """
    first, others = trials[0], [trial for trial in trials[1:] if not trial.refused]
    if first.refused and others:
        best = min(others, key=cost)
        return best, f"{best.name}: the map of {first.name} is refused ({first.refused})"
    if first.refused:
        return first, (
            f"{first.name} is kept, but no map of this drive can be right ({first.refused})"
        )
    if len(trials) == 1:
        return first, f"{first.name}: nothing to compare it with"
    gains = [(better_by(one, first), one) for one in others]
    better = [(gain, one) for gain, one in gains if gain]
    if not better:
        return first, f"{first.name} is kept: nothing is clearly better on the later half"
    gain, best = max(better, key=lambda pair: (sum(pair[0].values()), -pair[1].experiences))
    return best, f"{best.name}: clearly better than {first.name} by {' and '.join(gain)}"


def _for_network(
    found: dict[str, BrainConfig], drive: Drive, tuning: Tuning, assignments: Sequence[str]
) -> dict[str, BrainConfig]:
    """Return the candidates with a threshold for the views of a network."""
    if any(text.startswith("view.threshold") for text in assignments):
        return found
    shift = tuning.config.view.shift_match
    far = differences_of(drive.templates(tuning.keys), tuning.revisits.other, shift).mean()
    view = {"threshold": float(f"{SHARE * far:.3g}")}
    return {
        name: config
        if name == "given"
        else config.model_copy(update={"view": config.view.model_copy(update=view)})
        for name, config in found.items()
        if name != "second band"
    }


def _differences(drive: Drive, tuning: Tuning) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the differences of templates of the chosen config: near, revisits, other places."""
    view, revisits = tuning.config.view, tuning.revisits
    if drive.views is None:
        reduced = view.model_copy(update={"crop": drive.to_reduced(view.crop)})
        reduced = fitting(reduced, drive.shape)
        pictures = drive.pictures[tuning.keys]
        templates = np.stack([encode(picture, reduced).template for picture in pictures])
    else:
        templates = drive.templates(tuning.keys)
    each = np.arange(len(templates))
    pairs = np.stack([each[:-1], each[1:]], axis=1), revisits.same, revisits.other
    near, same, other = (differences_of(templates, one, view.shift_match) for one in pairs)
    return near, same, other


def _changes(before: BrainConfig, after: BrainConfig) -> dict[str, tuple[Any, Any]]:
    """Return the keys of two configs whose values differ."""
    changes = {}
    old, new = before.model_dump(), after.model_dump()
    for section, values in new.items():
        if isinstance(values, dict):
            for key, value in values.items():
                if isinstance(value, dict) or value == old[section][key]:
                    continue
                changes[f"{section}.{key}"] = (old[section][key], value)
    return changes
