"""Find the parameters of a video: views first, then motion, then the map as a whole."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from neuroslam.config import BrainConfig, to_toml
from neuroslam.config.sections import ViewConfig, region_in
from neuroslam.errors import RunError, counted
from neuroslam.figures.style import save
from neuroslam.figures.tuning import plot_tuning
from neuroslam.runs.files import write_text
from neuroslam.runs.saves import writing
from neuroslam.sensors import Source, open_source
from neuroslam.state.registry import leading_class
from neuroslam.threads import limit_threads
from neuroslam.tuning.drive import Drive, key_frames, read_drive
from neuroslam.tuning.motion import FieldOfView, field_of_view, measure_shifts
from neuroslam.tuning.revisits import Revisits, find_revisits, fitting
from neuroslam.tuning.search import Trial, best_of, consistency_limit, map_frames, score_map
from neuroslam.tuning.views import ViewScore, best_view, score_views
from neuroslam.view.features import view_encoder

MIN_REVISITS = 30
"""Fewest revisits for a search: below, a drive holds too little information about its loops."""

MAX_INCONSISTENCY = 0.5
"""Inconsistency of the best map above which the revisits are taken for false matches."""

_SIZES = ((60, 10), (40, 15), (32, 24), (20, 10))
_BANDS = ((0.0, 0.5), (0.0, 2 / 3), (1 / 6, 2 / 3), (1 / 3, 1.0))
_TURN_BANDS = ((0.0, 0.5), (0.25, 0.6), (0.0, 1.0), (0.4, 0.8))
_PATCHES = (0, 2, 4)
_ENERGIES = (0.1, 0.4)
_THRESHOLDS = 7


@dataclass
class Tuning:
    """The result of tuning.

    Attributes:
        config: The config found.
        changes: Key -> value before, value found, and reason, for each parameter tuned.
        notes: Messages for the user.
        revisits: Pairs of key frames that show the same place.
        keys: Positions of the key frames among the frames with a picture.
        views: Scores of the templates compared; the chosen one first.
        motion: The field of view; ``None`` where the loops do not determine it.
        trials: The maps of the search.
        before: The map of the config that tuning started from.
        after: The map of the config found.
    """

    config: BrainConfig
    revisits: Revisits
    keys: np.ndarray
    changes: dict[str, tuple[Any, Any, str]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    views: list[ViewScore] = field(default_factory=list)
    motion: FieldOfView | None = None
    trials: list[Trial] = field(default_factory=list)
    before: Trial | None = None
    after: Trial | None = None

    @property
    def verdict(self) -> str:
        """Whether to use the config found, in words."""
        old, new = self.before, self.after
        if old is None or new is None or not new.inconsistency >= 0.0:  # NaN: not known
            return "not known to be better: the drive has no revisits to measure it"
        fewer = old.n_experiences - new.n_experiences
        more = "fewer" if fewer > 0 else "more"
        size = f"{counted(abs(fewer), 'experience')} {more}" if fewer else "same size"
        if new.inconsistency > consistency_limit(old.inconsistency):
            return f"less consistent than before, {size}: keep the config you had"
        if old.inconsistency <= consistency_limit(new.inconsistency):
            return f"about as consistent as before, {size}"
        return f"more consistent than before, {size}: use the config found"

    def to_dict(self) -> dict[str, Any]:
        """Return the content of ``tune.json``."""
        return {
            "verdict": self.verdict,
            "revisits": len(self.revisits.same),
            "key_frames": len(self.keys),
            "changes": [
                {"key": key, "before": before, "found": found, "why": why}
                for key, (before, found, why) in self.changes.items()
            ],
            "notes": self.notes,
            "templates": [
                {
                    "features": score.config.features,
                    "crop": score.config.crop,
                    "width": score.config.template_width,
                    "height": score.config.template_height,
                    "patch_radius": score.config.patch_radius,
                    "average_precision": score.average_precision,
                }
                for score in self.views
            ],
            "maps": [_trial_to_dict(trial) for trial in self.trials],
            "before": _trial_to_dict(self.before),
            "after": _trial_to_dict(self.after),
        }


def _trial_to_dict(trial: Trial | None) -> dict[str, Any] | None:
    if trial is None:
        return None
    return {
        "threshold": trial.config.view.threshold,
        "inject_energy": trial.config.pose_cells.inject_energy,
        "inconsistency": None if math.isnan(trial.inconsistency) else trial.inconsistency,
        "templates": trial.n_templates,
        "experiences": trial.n_experiences,
        "links": trial.n_links,
    }


def tune(
    source: str | Path,
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    stop: int | None = None,
    overwrite: bool = False,
    on_stage: Callable[[str], None] | None = None,
    features: nn.Module | None = None,
) -> Tuning:
    """Find crop, template, threshold, field of view, speed and injection for a source's pictures.

    Tuning needs no ground truth. Revisits come from sequences of pictures. The template chosen
    separates them best from other places by single pictures, the field of view is the one for
    which loops close in heading, and threshold and injection give the most consistent map.

    Args:
        source: Any source with pictures that :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write: ``config.toml``, ``tune.json``, ``tune.png``.
        config: Config to start from, which gives all that is not tuned; ``None``: the defaults.
        stop: Frame to stop before; tuning reads at most 12 000 frames.
        overwrite: Replace an earlier tuning in ``out``.
        on_stage: Called with the name of each stage when it begins.
        features: Network that makes views, where ``config.view.features`` is ``"module"``. Crop
            and template size of a network are not tuned.

    Raises:
        SourceError: If the source cannot be read, or has fewer than a hundred pictures.
        RunError: If the source is live, the brain has no pose cells, or ``out`` cannot be written.
    """
    out, config = Path(out), config or BrainConfig()
    if not leading_class(config).needs_views:
        raise RunError(
            f"cells are {'+'.join(config.cells)}, expected pose: tuning is for brains that match "
            "views"
        )
    if stop is not None and stop < 1:
        raise RunError(f"stop is {stop}; expected 1 or more")
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder to write")
    _require_free(out, overwrite)
    opened = open_source(source, config.frame_rate_hz, config.view.grey)
    if opened.live:
        raise RunError(
            f"{opened.name}: is live; tuning reads its source several times, so tune on a recording"
        )
    report = on_stage or (lambda stage: None)
    with limit_threads():
        tuning = _tune(opened, config, stop, report, features)
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
    config: BrainConfig,
    stop: int | None,
    report: Callable[[str], None],
    features: nn.Module | None,
) -> Tuning:
    report("reading")
    made_once = config.view.features != "grey" or config.view.orientations > 0
    encoder = view_encoder(config.view, features) if made_once else None
    drive = read_drive(source, stop, encoder, config.view.grey)
    keys = key_frames(drive)
    report("finding revisits")
    revisits = find_revisits(drive.pictures[keys])
    tuning = Tuning(config, revisits, keys)
    if len(revisits.same) >= MIN_REVISITS:
        _search(tuning, drive, report)
    if not tuning.trials or best_of(tuning.trials).inconsistency > MAX_INCONSISTENCY:
        tuning = _without_loops(tuning, config, drive)
    if drive.unusable:
        tuning.notes.append(f"{counted(drive.unusable, 'frame')} could not be used, left out")
    report("mapping with the config found")
    _compare(tuning, source, drive, config)
    return tuning


def _search(tuning: Tuning, drive: Drive, report: Callable[[str], None]) -> None:
    report("choosing the template")
    _choose_view(tuning, drive, search=True)
    report("measuring turns and speed")
    _choose_motion(tuning, drive, search=True)
    report("comparing maps")
    _choose_threshold(tuning, drive)


def _without_loops(tried: Tuning, config: BrainConfig, drive: Drive) -> Tuning:
    """Tune what does not need revisits."""
    n = len(tried.revisits.same)
    none = tried.revisits._replace(same=np.empty((0, 2), int))
    tuning = Tuning(config, none, tried.keys)
    _choose_view(tuning, drive, search=False)
    _choose_motion(tuning, drive, search=False)
    why = "but no map agrees with them" if tried.trials else f"of at least {MIN_REVISITS} needed"
    tuning.notes.append(
        f"{n} of {len(tried.keys)} key frames seem to revisit a place, {why}: crop, template, "
        "field of view and injection are unchanged; drive the same route twice"
    )
    return tuning


def _set(tuning: Tuning, section: str, why: str, **values: object) -> None:
    """Change keys of a section, and record their values before."""
    current = getattr(tuning.config, section)
    for key, value in values.items():
        name = f"{section}.{key}"
        before = tuning.changes.get(name, (getattr(current, key),))[0]
        tuning.changes[name] = (before, value, why)
    tuning.config = tuning.config.model_copy(update={section: current.model_copy(update=values)})


def _choose_view(tuning: Tuning, drive: Drive, search: bool) -> None:
    if drive.views is None:
        _choose_template(tuning, drive, search)
    else:
        templates = drive.templates(tuning.keys)
        grey = fitting(ViewConfig(), drive.shape)  # for comparison
        tuning.views = [
            score_views(templates, tuning.config.view, tuning.revisits),
            *best_view(drive.pictures[tuning.keys], [grey], tuning.revisits),
        ]
    chosen = tuning.views[0]
    near, far = np.median(chosen.neighbours), np.quantile(chosen.others, 0.05)
    _set(tuning, "view", "between the differences of neighbours and of far frames",
         threshold=_rounded(max(0.005, math.sqrt(near * far))))  # fmt: skip


def _choose_template(tuning: Tuning, drive: Drive, search: bool) -> None:
    """Choose the grey template that separates places best."""
    pictures = drive.pictures[tuning.keys]
    best = tuning.config.view
    best = fitting(best.model_copy(update={"crop": drive.to_reduced(best.crop)}), drive.shape)
    if search:
        stages: tuple[list[dict[str, Any]], ...] = (
            [{"crop": None}, *({"crop": drive.region(0, 1, *band)} for band in _BANDS)],
            [{"template_width": width, "template_height": height} for width, height in _SIZES],
            [{"patch_radius": radius} for radius in _PATCHES],
        )
        for options in stages:
            scored = best_view(pictures, _usable(best, options, drive.shape), tuning.revisits)
            tuning.views = scored + tuning.views
            best = scored[0].config
        _set(tuning, "view", "separates places best",
             crop=drive.to_source(best.crop), template_width=best.template_width,
             template_height=best.template_height, patch_radius=best.patch_radius)  # fmt: skip
    else:
        tuning.views = best_view(pictures, [best], tuning.revisits)


def _usable(
    current: ViewConfig, options: list[dict[str, Any]], shape: tuple[int, ...]
) -> list[ViewConfig]:
    """Return the current config, and it with each option whose template fits into its crop."""
    configs = [current]
    for option in options:
        config = current.model_copy(update=option)
        x_min, x_max, y_min, y_max = region_in(config.crop or (0, -1, 0, -1), *shape[:2])
        fits = config.template_width <= x_max - x_min and config.template_height <= y_max - y_min
        if fits and config not in configs and 2 * config.shift_match < config.template_width:
            configs.append(config)
    return configs


def _choose_motion(tuning: Tuning, drive: Drive, search: bool) -> None:
    if drive.has_motion and tuning.config.odometry.use != "visual":
        tuning.notes.append("the source measures its motion itself: odometry is unchanged")
        return
    pictures = drive.pictures
    width = pictures.shape[2]
    max_shift = max(1, width // 4)
    if search:
        pairs = tuning.keys[tuning.revisits.same]
        regions = [drive.region(0, 1, top, bottom) for top, bottom in _TURN_BANDS]
        measured = [measure_shifts(pictures, region, max_shift) for region in regions]
        fields = [field_of_view(shifts, width, pairs) for shifts in measured]
        found = [one for one in fields if one is not None]
        best = min(found, key=lambda one: round(float(one.error.min()), 2), default=None)
        if best is None or best.error.min() > 0.5:
            tuning.notes.append("the loops do not determine the field of view: it is unchanged")
        else:
            tuning.motion = best
            _set(tuning, "odometry", "loops close in heading", fov_deg=best.fov_deg,
                 turn_region=drive.to_source(best.shifts.region))  # fmt: skip
    speed = measure_shifts(pictures, drive.region(0, 1, 0.5, 1.0), max_shift).difference
    typical = float(np.median(speed[speed > 0.2 * np.median(speed)]))
    duration_s = _view_duration_s(tuning, drive)
    cells = tuning.config.pose_cells
    # A camera has no metric scale: a view lasts as long as the robot needs for a new experience.
    scale = cells.create_threshold_cells * cells.cell_size_m / duration_s / max(typical, 1e-6)
    _set(tuning, "odometry", f"a view lasts {duration_s:.2g} s, as long as an experience",
         speed_scaling_m_s=_rounded(scale), max_speed_m_s=_rounded(4.0 * scale * typical),
         min_speed_m_s=_rounded(0.05 * scale * typical),
         max_shift_px=max_shift * drive.factor)  # fmt: skip


def _view_duration_s(tuning: Tuning, drive: Drive) -> float:
    """Return how long a view matches, at the threshold, in seconds."""
    times = np.array([drive.frames[key].time_s for key in tuning.keys])
    interval_s = float(np.median(np.diff(times)))
    return interval_s * tuning.views[0].lasts(tuning.config.view.threshold)


def _choose_threshold(tuning: Tuning, drive: Drive) -> None:
    chosen = tuning.views[0]
    high = max(float(np.quantile(chosen.others, 0.05)), 0.01)
    low = max(float(np.quantile(chosen.revisits, 0.1)), 0.2 * high)
    high = max(high, 1.5 * low)
    keys = np.array([drive.frames[key].index for key in tuning.keys])

    def attempt(threshold: float, energy: float) -> Trial:
        config = tuning.config.model_copy(
            update={
                "view": tuning.config.view.model_copy(update={"threshold": threshold}),
                "pose_cells": tuning.config.pose_cells.model_copy(update={"inject_energy": energy}),
            }
        )
        brain, experiences = map_frames(_on_reduced(config, drive), drive.frames, drive.views)
        return score_map(config, brain, experiences, keys, tuning.revisits)

    energy = tuning.config.pose_cells.inject_energy
    thresholds = [_rounded(t) for t in np.geomspace(low, high, _THRESHOLDS)]
    tuning.trials = [attempt(threshold, energy) for threshold in thresholds]
    best = best_of(tuning.trials)
    others = [attempt(best.config.view.threshold, more) for more in _ENERGIES if more != energy]
    tuning.trials += others
    better = min(others, key=lambda trial: trial.inconsistency)
    if better.inconsistency < 0.9 * best.inconsistency:
        best = better
    why = "smallest map among the consistent ones"
    _set(tuning, "view", why, threshold=best.config.view.threshold)
    _set(tuning, "pose_cells", why, inject_energy=best.config.pose_cells.inject_energy)


def _on_reduced(config: BrainConfig, drive: Drive) -> BrainConfig:
    """Return the config for the reduced pictures."""
    odometry, view = config.odometry, config.view
    return config.model_copy(
        update={
            "odometry": odometry.model_copy(
                update={
                    "speed_region": drive.to_reduced(odometry.speed_region),
                    "turn_region": drive.to_reduced(odometry.turn_region),
                    "max_shift_px": max(1, odometry.max_shift_px // drive.factor),
                }
            ),
            "view": view.model_copy(update={"crop": drive.to_reduced(view.crop)}),
        }
    )


def _compare(tuning: Tuning, source: Source, drive: Drive, before: BrainConfig) -> None:
    """Map the source itself, not the reduced pictures, with the config before and after."""
    keys = np.array([drive.frames[key].index for key in tuning.keys])
    last = drive.frames[-1].index + 1
    maps = []
    for config in (before, tuning.config):
        frames = source.frames(stop=last, on_bad_frame=lambda fault: None)
        brain, experiences = map_frames(config, frames, drive.views)
        maps.append(score_map(config, brain, experiences, keys, tuning.revisits))
    tuning.before, tuning.after = maps


def _rounded(value: float) -> float:
    """Round to three digits, the accuracy of tuning."""
    return float(f"{value:.3g}")
