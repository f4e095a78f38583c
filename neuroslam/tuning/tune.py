"""From a video to the parameters it needs: views first, then motion, then the map as a whole."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from neuroslam.config import BrainConfig, to_toml
from neuroslam.config.sections import ViewConfig
from neuroslam.errors import RunError, counted
from neuroslam.figures.style import save
from neuroslam.figures.tuning import plot_tuning
from neuroslam.runs.files import write_text
from neuroslam.runs.parallel import one_thread
from neuroslam.sensors import Source, open_source
from neuroslam.state.registry import leading_class
from neuroslam.tuning.drive import Drive, key_frames, read_drive
from neuroslam.tuning.motion import FieldOfView, field_of_view, measure_shifts
from neuroslam.tuning.revisits import Revisits, find_revisits, fitting
from neuroslam.tuning.search import Trial, best_of, drive_through, judge, level_with
from neuroslam.tuning.views import ViewScore, best_view, score_views
from neuroslam.view.features import FeatureEncoder

FEW_REVISITS = 30
"""Revisits below which a drive tells too little about its loops to search by them."""

CONTRADICTED = 0.5
"""Inconsistency from which on no map agrees with the revisits: they were none."""

_SIZES = ((60, 10), (40, 15), (32, 24), (20, 10))
_BANDS = ((0.0, 0.5), (0.0, 2 / 3), (1 / 6, 2 / 3), (1 / 3, 1.0))
_TURN_BANDS = ((0.0, 0.5), (0.25, 0.6), (0.0, 1.0), (0.4, 0.8))
_PATCHES = (0, 2, 4)
_ENERGIES = (0.1, 0.4)
_THRESHOLDS = 7


@dataclass
class Tuning:
    """What tuning found.

    Attributes:
        config: The config to map with.
        changes: Key -> value before, value found, and why, for each parameter looked at.
        notes: What the user should know.
        revisits: Which key frames show one place.
        keys: Numbers of the key frames among the frames with a picture.
        views: The templates that were compared; the one chosen first.
        motion: Field of view, and the error of the others; ``None``: loops do not tell.
        trials: The maps of the search.
        before: The map of the config that tuning began with.
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
        """Whether the config found is worth taking, in words."""
        old, new = self.before, self.after
        if old is None or new is None or not new.inconsistency >= 0.0:  # NaN: not known
            return "not known to be better: the drive does not tell"
        fewer = old.n_places - new.n_places
        more = "fewer" if fewer > 0 else "more"
        size = f"{counted(abs(fewer), 'place')} {more}" if fewer else "as large"
        if new.inconsistency > level_with(old.inconsistency):
            return f"less consistent than before, {size}: keep what you had"
        if old.inconsistency <= level_with(new.inconsistency):
            return f"about as consistent as before, {size}"
        return f"more consistent than before, {size}: take it"

    def to_dict(self) -> dict[str, Any]:
        """Name every figure: the content of ``tune.json``."""
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
            "maps": [_told(trial) for trial in self.trials],
            "before": _told(self.before),
            "after": _told(self.after),
        }


def _told(trial: Trial) -> dict[str, Any]:
    return {
        "threshold": trial.config.view.threshold,
        "inject_energy": trial.config.pose_cells.inject_energy,
        "inconsistency": None if math.isnan(trial.inconsistency) else trial.inconsistency,
        "templates": trial.n_views,
        "experiences": trial.n_places,
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

    No truth is needed. Revisits are found in sequences of pictures, the template is the one that
    tells them from other places by single pictures, turns and their scale are such that loops
    close, and threshold and injection are those of the most consistent map.

    Args:
        source: Anything with pictures that :func:`neuroslam.sensors.open_source` opens.
        out: Folder to write: ``config.toml``, ``tune.json``, ``tune.png``.
        config: What is not tuned is taken from it; the defaults if not given.
        stop: Frame to stop before; at most 12 000 frames are looked at.
        overwrite: Replace an earlier tuning in ``out``.
        on_stage: Called with what is being done.
        features: Network that makes views, where ``config.view.features`` is ``"module"``. Of a
            network, crop and size of the template stay as they are.

    Raises:
        SourceError: If the source cannot be read, or has fewer than a hundred pictures.
        RunError: If the source is live, the brain has no pose cells, or ``out`` cannot be written.
    """
    out, config = Path(out), config or BrainConfig()
    if not leading_class(config).needs_views:
        raise RunError(f"cells are {'+'.join(config.cells)}; tuning is of views, which needs pose")
    if stop is not None and stop < 1:
        raise RunError(f"stop is {stop}; expected 1 or more")
    if out.exists() and not out.is_dir():
        raise RunError(f"{out}: is a file; expected a folder to write")
    if (out / "config.toml").exists() and not overwrite:
        raise RunError(f"{out}: holds a config.toml already; take another folder or --overwrite")
    opened = open_source(source, config.frame_rate_hz)
    if opened.live:
        raise RunError(f"{opened.name}: is live; tuning looks several times, so tune a recording")
    tell = on_stage or (lambda stage: None)
    with one_thread():
        tuning = _tune(opened, config, stop, tell, features)
        figure = plot_tuning(tuning, opened.name)
    try:
        out.mkdir(parents=True, exist_ok=True)
        save(figure, out / "tune.png")
        write_text(out / "tune.json", json.dumps(tuning.to_dict(), indent=2) + "\n")
        write_text(out / "config.toml", to_toml(tuning.config))
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return tuning


def _tune(
    source: Source,
    config: BrainConfig,
    stop: int | None,
    tell: Callable[[str], None],
    features: nn.Module | None,
) -> Tuning:
    tell("reading")
    encoder = None if config.view.features == "grey" else FeatureEncoder(config.view, features)
    drive = read_drive(source, stop, encoder)
    keys = key_frames(drive)
    tell("looking for places seen twice")
    revisits = find_revisits(drive.pictures[keys])
    tuning = Tuning(config, revisits, keys)
    if len(revisits.same) >= FEW_REVISITS:
        _search(tuning, drive, tell)
    if not tuning.trials or best_of(tuning.trials).inconsistency > CONTRADICTED:
        tuning = _without_loops(tuning, config, drive)
    if drive.unusable:
        tuning.notes.append(f"{drive.unusable} frames could not be used and were left out")
    tell("mapping with what was found")
    _compare(tuning, source, drive, config)
    return tuning


def _search(tuning: Tuning, drive: Drive, tell: Callable[[str], None]) -> None:
    tell("choosing the template")
    _choose_view(tuning, drive, search=True)
    tell("measuring turns and speed")
    _choose_motion(tuning, drive, search=True)
    tell("making maps")
    _choose_threshold(tuning, drive)


def _without_loops(tried: Tuning, config: BrainConfig, drive: Drive) -> Tuning:
    """Tune what can be where no place was seen twice."""
    n = len(tried.revisits.same)
    none = tried.revisits._replace(same=np.empty((0, 2), int))
    tuning = Tuning(config, none, tried.keys)
    _choose_view(tuning, drive, search=False)
    _choose_motion(tuning, drive, search=False)
    why = "none of the maps agrees that they do" if tried.trials else "too few to go by"
    tuning.notes.append(
        f"{n} of {len(tried.keys)} key frames seem to show a place seen before, {why}: crop, "
        "template, field of view and injection are as they were; drive the same way twice"
    )
    return tuning


def _set(tuning: Tuning, section: str, why: str, **values: object) -> None:
    """Change keys of a section, and remember what they were."""
    now = getattr(tuning.config, section)
    for key, value in values.items():
        name = f"{section}.{key}"
        before = tuning.changes.get(name, (getattr(now, key),))[0]
        tuning.changes[name] = (before, value, why)
    tuning.config = tuning.config.model_copy(update={section: now.model_copy(update=values)})


def _choose_view(tuning: Tuning, drive: Drive, search: bool) -> None:
    if drive.views is None:
        _choose_template(tuning, drive, search)
    else:
        templates = drive.templates(tuning.keys)
        grey = fitting(ViewConfig(), drive.frames[0].image.shape)  # for comparison
        tuning.views = [
            score_views(templates, tuning.config.view, tuning.revisits),
            *best_view(drive.pictures[tuning.keys], [grey], tuning.revisits),
        ]
    chosen = tuning.views[0]
    alike, unlike = np.median(chosen.neighbours), np.quantile(chosen.others, 0.05)
    _set(tuning, "view", "between neighbours and far frames",
         threshold=_rounded(max(0.005, math.sqrt(alike * unlike))))  # fmt: skip


def _choose_template(tuning: Tuning, drive: Drive, search: bool) -> None:
    """Choose what tells places best apart in pictures of grey."""
    pictures = drive.pictures[tuning.keys]
    now = tuning.config.view
    now = fitting(now.model_copy(update={"crop": drive.here(now.crop)}), pictures[0].shape)
    if search:
        for options in (
            [{"crop": None}, *({"crop": drive.region(0, 1, *band)} for band in _BANDS)],
            [{"template_width": width, "template_height": height} for width, height in _SIZES],
            [{"patch_radius": radius} for radius in _PATCHES],
        ):
            scored = best_view(pictures, _usable(now, options, pictures[0].shape), tuning.revisits)
            tuning.views = scored + tuning.views
            now = scored[0].config
        _set(tuning, "view", "best tells places apart",
             crop=drive.in_source(now.crop), template_width=now.template_width,
             template_height=now.template_height, patch_radius=now.patch_radius)  # fmt: skip
    else:
        tuning.views = best_view(pictures, [now], tuning.revisits)


def _usable(
    now: ViewConfig, options: list[dict[str, Any]], shape: tuple[int, ...]
) -> list[ViewConfig]:
    """Return the config as it is and with each option whose template fits into its crop."""
    configs = [now]
    for option in options:
        config = now.model_copy(update=option)
        x_min, x_max, y_min, y_max = config.crop or (0, shape[1], 0, shape[0])
        fits = config.template_width <= x_max - x_min and config.template_height <= y_max - y_min
        if fits and config not in configs and 2 * config.shift_match < config.template_width:
            configs.append(config)
    return configs


def _choose_motion(tuning: Tuning, drive: Drive, search: bool) -> None:
    if drive.has_motion and tuning.config.odometry.use != "visual":
        tuning.notes.append("the source measures its motion itself: odometry is as it was")
        return
    pictures = drive.pictures
    width = pictures.shape[2]
    max_shift = max(1, width // 4)
    if search:
        pairs = tuning.keys[tuning.revisits.same]
        regions = [drive.region(0, 1, top, bottom) for top, bottom in _TURN_BANDS]
        measured = [measure_shifts(pictures, region, max_shift) for region in regions]
        fields = [field_of_view(shifts, width, pairs) for shifts in measured]
        fields = [one for one in fields if one is not None]
        tuning.motion = min(fields, key=lambda one: round(float(one.error.min()), 2), default=None)
        if tuning.motion is not None and tuning.motion.error.min() > 0.5:
            tuning.motion = None
        if tuning.motion is None:
            tuning.notes.append("the loops do not tell the field of view: it is as it was")
        else:
            _set(tuning, "odometry", "loops close in heading", fov_deg=tuning.motion.fov_deg,
                 turn_region=drive.in_source(tuning.motion.shifts.region))  # fmt: skip
    speed = measure_shifts(pictures, drive.region(0, 1, 0.5, 1.0), max_shift).difference
    typical = float(np.median(speed[speed > 0.2 * np.median(speed)]))
    lasting_s = _lasting_s(tuning, drive)
    cells = tuning.config.pose_cells
    scale = cells.create_threshold_cells * cells.cell_size_m / lasting_s / max(typical, 1e-6)
    _set(tuning, "odometry", f"a view lasts {lasting_s:.2g} s, and so a place",
         speed_scaling_m_s=_rounded(scale), max_speed_m_s=_rounded(4.0 * scale * typical),
         min_speed_m_s=_rounded(0.05 * scale * typical),
         max_shift_px=max_shift * drive.factor)  # fmt: skip


def _lasting_s(tuning: Tuning, drive: Drive) -> float:
    """Return how long a view is seen, at the threshold, in seconds."""
    times = np.array([drive.frames[key].time_s for key in tuning.keys])
    apart = np.diff(times)
    return float(np.median(apart)) * tuning.views[0].lasts(tuning.config.view.threshold)


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
        brain, places = drive_through(_on_small(config, drive), drive.frames, drive.views)
        return judge(config, brain, places, keys, tuning.revisits)

    energy = tuning.config.pose_cells.inject_energy
    thresholds = [_rounded(t) for t in np.geomspace(low, high, _THRESHOLDS)]
    tuning.trials = [attempt(threshold, energy) for threshold in thresholds]
    best = best_of(tuning.trials)
    others = [attempt(best.config.view.threshold, more) for more in _ENERGIES if more != energy]
    tuning.trials += others
    better = min(others, key=lambda trial: trial.inconsistency)
    if better.inconsistency < 0.9 * best.inconsistency:
        best = better
    why = "smallest of the consistent maps"
    _set(tuning, "view", why, threshold=best.config.view.threshold)
    _set(tuning, "pose_cells", why, inject_energy=best.config.pose_cells.inject_energy)


def _on_small(config: BrainConfig, drive: Drive) -> BrainConfig:
    """Return the config for the small pictures."""
    odometry, view = config.odometry, config.view
    return config.model_copy(
        update={
            "odometry": odometry.model_copy(
                update={
                    "speed_region": drive.here(odometry.speed_region),
                    "turn_region": drive.here(odometry.turn_region),
                    "max_shift_px": max(1, odometry.max_shift_px // drive.factor),
                }
            ),
            "view": view.model_copy(update={"crop": drive.here(view.crop)}),
        }
    )


def _compare(tuning: Tuning, source: Source, drive: Drive, before: BrainConfig) -> None:
    """Map the source itself, not the small pictures, with the config before and the one found."""
    keys = np.array([drive.frames[key].index for key in tuning.keys])
    last = drive.frames[-1].index + 1
    maps = []
    for config in (before, tuning.config):
        frames = source.frames(stop=last, on_bad_frame=lambda fault: None)
        brain, places = drive_through(config, frames, drive.views)
        maps.append(judge(config, brain, places, keys, tuning.revisits))
    tuning.before, tuning.after = maps


def _rounded(value: float) -> float:
    """Three digits: more say nothing, and are tiresome to read."""
    return float(f"{value:.3g}")
