"""Two sessions become one: the map of one joined to that of another where they meet."""

from copy import deepcopy
from typing import NamedTuple

import numpy as np

from neuroslam.errors import counted
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.joining import links_kept
from neuroslam.merging.limits import far_off, tolerance
from neuroslam.merging.mapped import Mapped, differing
from neuroslam.merging.report import MergeReport
from neuroslam.merging.states import merge_states, part_of
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State

_CHECK_STEPS = 2_000_000
"""Links times loops of the relaxation that tries a merged map: a fraction of a second."""

_STRAINED = 0.1
"""A link that relaxation leaves off by more than this share of its length is strained."""

_TORN = 0.5
"""Strained links may be off by this share of their length: odometry may be that wrong."""


class Merged(NamedTuple):
    """What became of two states.

    Attributes:
        state: Of the merged brain, without stored maps; ``None`` where the merge is refused.
        join: How ids and coordinates of the partial session have changed; ``None``: not tried.
        report: What was done, or why not; what populations count is not in it.
    """

    state: State | None
    join: Join | None
    report: MergeReport


def merge(loaded: Mapped, partial: Mapped, match: Match) -> Merged:
    """Merge the states of two brains into a new one; neither is altered.

    The merged map is relaxed on a copy first. If that leaves the links off by much more than they
    were, the experiences were not the same, and the merge is refused.

    Args:
        loaded: The brain that is merged into: its ids stay.
        partial: The brain whose session goes on: its activity, time and odometry are kept.
        match: Where they meet.

    Raises:
        MapError: If the match names experiences that are not there.
    """
    report = MergeReport(
        False, "", None,
        [session.name for session in loaded.sessions.sessions],
        [session.name for session in partial.sessions.sessions],
    )  # fmt: skip
    apart = differing(loaded, partial)
    if apart:
        report.reason = f"views or cells were made with different configs: {'; '.join(apart)}"
        return Merged(None, None, report)
    report.reason = _beyond_odometry(loaded, partial, match)
    if report.reason:
        return Merged(None, None, report)
    one, other = (
        {n: value.cpu() for n, value in brain.state_dict().items() if not n.startswith("stored.")}
        for brain in (loaded, partial)
    )
    state, join = merge_states(one, other, match, partial.config, partial.parts())
    merged = ExperienceMap(partial.map.config, partial.map.torus, partial.map.threshold_cells)
    merged.load_state_dict(part_of(state, "map"))
    if not partial.leader.relaxes_map:
        merged.reset_links()  # a place cell that became another's lies where that does
        state |= {f"map.{name}": value for name, value in merged.state_dict().items()}
    _describe(report, loaded, partial, merged, match, join)
    strain, allowed = _strain(report, loaded.map, partial, merged, join)
    if strain > allowed:
        report.reason = (
            f"the merged map contradicts itself: its strained links would be off by "
            f"{strain:.3f} m, at most {allowed:.3f} m is allowed"
        )
        return Merged(None, join, report)
    report.merged = True
    new = merged.n - loaded.map.n
    report.reason = (
        f"{counted(new, 'experience is', 'experiences are')} new"
        if new
        else "nothing is new: every experience was known"
    )
    return Merged(state, join, report)


def _beyond_odometry(loaded: Mapped, partial: Mapped, match: Match) -> str:
    """Say which of the pairs odometry cannot have so far apart."""
    pairs = match.pairs
    inside = (pairs.loaded < loaded.map.n) & (pairs.partial < partial.map.n)
    if len(pairs.partial) == 1 or not inside.all():
        return ""
    limits = tolerance((loaded.map, partial.map), partial.config)
    off_m, allowed_m = far_off(pairs, loaded.map, partial.map, limits)
    worst = int(np.argmax(off_m - allowed_m))
    if off_m[worst] <= allowed_m[worst]:
        return ""
    return (
        f"experiences {pairs.partial[worst]} and {pairs.loaded[worst]} cannot be the same: aligned "
        f"by the match they are {off_m[worst]:.2f} m apart, odometry may be off by "
        f"{allowed_m[worst]:.2f} m"
    )


def _describe(
    report: MergeReport,
    loaded: Mapped,
    partial: Mapped,
    merged: ExperienceMap,
    match: Match,
    join: Join,
) -> None:
    def experience(brain: Mapped, name: str, number: int) -> dict[str, int]:
        row = brain.map.experiences
        return {
            f"{name}_experience": number,
            f"{name}_view": int(row["template"][number]),
            f"{name}_frame": int(row["first_frame"][number]),
        }

    report.match = {
        **experience(loaded, "loaded", match.loaded),
        **experience(partial, "partial", match.partial),
        "error": float(match.error) if partial.leader.relaxes_map else None,
        "runner_up": None if match.runner_up is None else float(match.runner_up),
        "relative_heading_rad": float(match.turn_rad),
        "places": len(match.pairs.partial),
    }
    # From minus half to half of the torus is easier to read.
    report.cell_shift = [
        float((shift + n / 2) % n - n / 2)
        for shift, n in zip(join.cell_shift, join.torus, strict=True)
    ]
    report.rotation_rad = join.rotation_rad
    report.translation_m = [
        join.onto.x_m - join.pivot.x_m, join.onto.y_m - join.pivot.y_m
    ]  # fmt: skip
    report.counts = {
        "views": {
            "loaded": loaded.view.n,
            "partial": partial.view.n,
            "merged": loaded.view.n + len(join.kept_views),
        }
    }
    for name in ("experiences", "links"):
        attribute = "n" if name == "experiences" else "n_links"
        report.counts[name] = {
            "loaded": getattr(loaded.map, attribute),
            "partial": getattr(partial.map, attribute),
            "merged": getattr(merged, attribute),
        }


def _strain(
    report: MergeReport, loaded: ExperienceMap, partial: Mapped, merged: ExperienceMap, join: Join
) -> tuple[float, float]:
    """Relax a copy of the merged map: how far off are its strained links; how far may they be?"""
    new = links_kept(partial.map.links, loaded.links, join)
    before = np.concatenate([loaded.residuals_m, partial.map.residuals_m[new]])
    tried = deepcopy(merged)
    loops = min(max(_CHECK_STEPS // max(1, len(before)), 100), 5000)
    if len(join.kept_experiences) < len(join.experiences) - 1:  # one experience strains nothing
        tried.relax(loops)
    after, length = tried.residuals_m, tried.links.distance_m
    report.residual_before_m, report.residual_after_m = _rms(before), _rms(after)
    moved = tried.poses[:, :2] - merged.poses[:, :2]
    report.largest_correction_m = float(np.hypot(*moved.T).max())
    strained = (after > before) & (after > _STRAINED * length)
    factor = partial.config.sessions.residual_factor
    allowed = max(factor * _rms(before[strained]), _TORN * _rms(length[strained]))
    return _rms(after[strained]), allowed


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
