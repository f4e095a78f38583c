r"""Figures of a map without ground truth, by which the candidates of a tuning are compared.

Revisits come from sequences of pictures (:mod:`neuroslam.tuning.revisits`), not from the brain
whose map is scored. A map is right if it places revisits on one path, keeps different places
apart, links none of them, and stops growing on known ground.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame, counted
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.reading import trajectory
from neuroslam.tuning.revisits import Revisits
from neuroslam.types import Frame
from neuroslam.view.preprocess import Encoded

MIN_ON_MAP = 0.9
"""Share of the frames on one map below which a map is refused."""

MIN_APART = 0.8
"""Share of the pairs of different places that a map keeps apart, below which it has collapsed."""

MAX_GROWTH = 0.8
"""Growth on known ground, relative to the first lap, from which loops do not close."""

MAX_ERROR = 0.1
"""Distance of revisits, relative to the diagonal, from which a map does not close."""

MIN_ASPECT = 0.6
"""Aspect of a map, relative to the median of all, below which it is squashed."""

MIN_LINKS = 10
"""Loop links below which their share of wrong ones is not known: one of a few, wrong or judged so
by mistake, would decide."""

_NEAR = 0.05  # of the diagonal: nearer than this, two places are not apart
_LAP_PARTS = 5  # key frames beside a revisit among which the nearest position counts
_LARGER = 1.5  # times the size of another map, and
_ROOM = 200  # so many experiences and templates more, beyond which a candidate is given up


@dataclass(frozen=True)
class Trial:
    """The map that a candidate gives of a drive; figures of its later half, NaN if unknown.

    Attributes:
        name: Name of the candidate.
        config: Its config.
        on_map: Share of all frames on the final map.
        new_maps: Maps that a kidnapping or a gap began, and sessions after a jump.
        error: 90th percentile of the distance of a frame from the path of its nearest revisit,
            relative to the diagonal of the map.
        wrong_links: Share of the loop links that join places which the sequences tell apart; NaN
            for fewer than :data:`MIN_LINKS` links.
        growth: New experiences per frame in the last third, relative to the first lap.
        apart: Share of the pairs of different places that are apart on the map.
        aspect: Shorter over longer principal axis of the map.
        experiences: Number of experiences.
        templates: Number of templates.
        track_xy: Position of each frame on the map, m, ``(n, 2)``; NaN off the map.
        sizes: Experiences and templates made up to each frame, in all its maps, ``(n,)``.
        refused: Why the map cannot be right; empty if it can.
    """

    name: str
    config: BrainConfig
    on_map: float
    new_maps: int
    error: float
    wrong_links: float
    growth: float
    apart: float
    aspect: float
    experiences: int
    templates: int
    track_xy: np.ndarray
    sizes: np.ndarray
    refused: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, for ``tune.json``; unknown ones are ``None``."""
        names = (
            "on_map", "new_maps", "error", "wrong_links", "growth", "apart", "aspect",
            "experiences", "templates",
        )  # fmt: skip
        known = {name: getattr(self, name) for name in names}
        return {
            "name": self.name,
            **{name: None if math.isnan(value) else value for name, value in known.items()},
            "refused": self.refused,
        }


class Mapped:
    """A brain that has mapped frames, where they are, and the size of the map meanwhile.

    Args:
        config: Config of the brain; it has pose cells alone, all else is as in a run.
        frames: Frames with pictures.
        views: Templates of a network by frame index, as bytes; a frame without one is left out.
            ``None`` for grey templates.
        sizes: Of another map; this one is given up where it is much larger.
    """

    def __init__(
        self,
        config: BrainConfig,
        frames: Iterable[Frame],
        views: Mapping[int, Encoded] | None = None,
        sizes: np.ndarray | None = None,
    ) -> None:
        current = -1

        def look_up(_image: np.ndarray) -> Encoded:
            if views is None or current not in views:
                raise BadFrame("the network made no template of it")
            return Encoded(views[current].template / 255.0, views[current].contrast)

        alone = config.model_copy(update={"cells": ("pose",)})
        self.brain = brain = NavigationBrain(alone, features=None if views is None else look_up)
        rows, grown, indices, made = [], [], [], 0
        self.stopped = False
        with torch.inference_mode():
            for frame in frames:
                current = frame.index
                try:
                    result = brain(frame)
                except BadFrame:
                    continue
                indices.append(frame.index)
                rows.append((*brain.map.origin, *brain.map.offset))
                made += (result.action == "create") + result.view.is_new
                grown.append(made)
                k = len(grown) - 1
                if sizes is not None and grown[k] > _LARGER * sizes[min(k, len(sizes) - 1)] + _ROOM:
                    self.stopped = True
                    break
        names = ("session", "number", "dx_m", "dy_m", "dtheta_rad")
        columns = np.array(rows).T
        trace: dict[str, np.ndarray] = {name: columns[i] for i, name in enumerate(names)}
        self.frames = np.array(indices)
        self.sizes = np.array(grown)
        self.track_xy = trajectory(brain, trace)[:, :2]


def score(
    name: str, config: BrainConfig, mapped: Mapped, keys: np.ndarray, found: Revisits
) -> Trial:
    """Measure the figures of a map.

    Args:
        name: Name of the candidate.
        config: Config that the trial holds.
        mapped: The brain after the drive.
        keys: Frame indices of the key frames.
        found: Pairs of key frames.
    """
    track, brain = mapped.track_xy, mapped.brain
    at = track[np.searchsorted(mapped.frames, keys).clip(max=len(track) - 1)]
    known = track[np.isfinite(track[:, 0])]
    diagonal = float(np.linalg.norm(np.ptp(known, axis=0))) if len(known) else 0.0
    return Trial(
        name, config, len(known) / len(track), len(brain.sessions.sessions) - 1,
        _error(at, found.same, diagonal), _wrong_links(brain, keys, found),
        _growth(brain, keys, found), _apart(at, found.other, diagonal), _aspect(known),
        brain.map.n, brain.view.n, track, mapped.sizes,
    )  # fmt: skip


def given_up(name: str, config: BrainConfig, mapped: Mapped) -> Trial:
    """Return a candidate that was stopped early, without figures."""
    unknown = math.nan
    why = f"grows much faster, stopped after {counted(len(mapped.frames), 'frame')}"
    return Trial(
        name, config, unknown, 0, unknown, unknown, unknown, unknown, unknown,
        mapped.brain.map.n, mapped.brain.view.n, mapped.track_xy, mapped.sizes, why,
    )  # fmt: skip


def refuse(trials: list[Trial]) -> list[Trial]:
    """Return the trials, with the reason where a map cannot be right."""
    whole = [trial.aspect for trial in trials if not math.isnan(trial.aspect)]
    usual = float(np.median(whole)) if whole else 0.0
    return [one if one.refused else replace(one, refused=_fault(one, usual)) for one in trials]


def _fault(trial: Trial, usual_aspect: float) -> str:
    if trial.on_map < MIN_ON_MAP:
        return f"{100 * trial.on_map:.0f} % of the frames on one map"
    if trial.apart < MIN_APART:
        return f"collapsed: {100 * (1 - trial.apart):.0f} % of different places coincide"
    if trial.error > MAX_ERROR:
        return f"open: revisits are {100 * trial.error:.0f} % of the diagonal apart"
    if trial.growth > MAX_GROWTH:
        return f"grows on known ground as on the first lap ({trial.growth:.2f} of it)"
    if trial.aspect < MIN_ASPECT * usual_aspect:
        return f"squashed: aspect {trial.aspect:.2f}, others {usual_aspect:.2f}"
    return ""


def _error(at: np.ndarray, same: np.ndarray, diagonal: float) -> float:
    """Return the 90th percentile of the distances from the path of the nearest revisit."""
    late = same[same[:, 1] >= len(at) // 2]
    if not len(late) or diagonal <= 0.0:
        return math.nan
    beside = np.arange(-_LAP_PARTS, _LAP_PARTS + 1)
    path = at[(late[:, :1] + beside).clip(0, len(at) - 1)]
    apart = np.linalg.norm(path - at[late[:, 1], None], axis=2)
    apart = np.where(np.isnan(apart), np.inf, apart).min(axis=1)
    apart = apart[np.isfinite(apart)]
    return float(np.quantile(apart, 0.9)) / diagonal if len(apart) else math.nan


def _apart(at: np.ndarray, other: np.ndarray, diagonal: float) -> float:
    if not len(other):
        return math.nan
    distances = np.linalg.norm(at[other[:, 0]] - at[other[:, 1]], axis=1)
    distances = distances[np.isfinite(distances)]
    return float((distances > _NEAR * diagonal).mean()) if len(distances) else 0.0


def _aspect(track: np.ndarray) -> float:
    if len(track) < 2:
        return 0.0
    turned = (track - track.mean(axis=0)) @ np.linalg.svd(np.cov(track.T))[0]
    longer, shorter = np.ptp(turned, axis=0)
    return float(shorter / longer) if longer > 0 else 0.0


def _wrong_links(brain: NavigationBrain, keys: np.ndarray, found: Revisits) -> float:
    """Return the share of the loop links whose places the sequences distinguish; NaN for few."""
    source, target = (end[closes_loop(*brain.map.links[:2])] for end in brain.map.links[:2])
    first = brain.map.experiences["first_frame"].numpy()
    i, j = (np.searchsorted(keys, first[end]).clip(max=len(keys) - 1) for end in (source, target))
    far = np.abs(i - j) >= found.gap
    if far.sum() < MIN_LINKS:
        return math.nan
    wrong = ~(found.near | found.unsure)
    return float(wrong[i[far], j[far]].mean())


def _growth(brain: NavigationBrain, keys: np.ndarray, found: Revisits) -> float:
    """Return new experiences per frame in the last third, relative to the first lap."""
    if not len(found.same):
        return math.nan
    lap = int(np.median(found.same[:, 1] - found.same[:, 0]))
    first = brain.map.experiences["first_frame"].numpy()
    begins, ends = keys[0], keys[-1]
    later = max(keys[min(lap, len(keys) - 1)], begins + 2 * (ends - begins) // 3)
    if later >= ends:
        return math.nan
    lap_frames = keys[min(lap, len(keys) - 1)] - begins
    early = float((first < begins + lap_frames).sum()) / max(1, lap_frames)
    return float((first >= later).sum() / (ends - later) / max(early, 1e-9))


FIGURES = {
    "off the map": (lambda one: 1.0 - one.on_map, 0.005, 0.02),
    "error": (lambda one: one.error, 0.001, 0.003),
    "wrong links": (lambda one: float(np.nan_to_num(one.wrong_links)), 0.002, 0.01),
    "growth": (lambda one: one.growth, 0.02, 0.05),
    "new maps": (lambda one: float(one.new_maps), 0.0, 1.0),
}
"""Figures that decide, smaller for a better map: how much larger still counts as equal, and how
much smaller is clearly better. Of few loop links none counts as wrong."""


def cost(one: Trial) -> float:
    """Return the sum of a map's figures, each in units of what is clear."""
    known = ((figure(one), clear) for figure, _, clear in FIGURES.values())
    return sum(value / clear for value, clear in known if not math.isnan(value))


def better_by(one: Trial, than: Trial) -> dict[str, float]:
    """Return by which figures a map is clearly better, if it is worse by none; empty otherwise.

    The gain is in units of what is clear, so that gains of several figures can be added.
    """
    gains = {}
    for name, (figure, equal, clear) in FIGURES.items():
        if math.isnan(figure(than)):
            continue
        gain = figure(than) - figure(one)
        if not gain >= -equal:
            return {}
        if gain >= clear:
            gains[name] = gain / clear
    return gains
