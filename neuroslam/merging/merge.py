"""Merging of two sessions: one map from two, aligned by their match."""

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
"""Links times loops of the trial relaxation of a merged map: a fraction of a second."""

_STRAINED = 0.1
"""A link is strained if its residual after relaxation exceeds this share of its length."""

_TORN = 0.5
"""Allowed residual of strained links, as a share of their length, for errors of odometry."""


class Merged(NamedTuple):
    """The result of a merge.

    Attributes:
        state: State of the merged brain, without stored maps; ``None`` if the merge is refused.
        join: Changes of ids and coordinates of the partial session; ``None``: not computed.
        report: Report of the merge, without the counts of populations.
    """

    state: State | None
    join: Join | None
    report: MergeReport


def merge(loaded: Mapped, partial: Mapped, match: Match) -> Merged:
    """Merge the states of two brains into a new one; neither is altered.

    A copy of the merged map is relaxed first. If the residuals of links remain much larger than
    before, the matched experiences were not the same, and the merge is refused.

    Args:
        loaded: The brain that is merged into; its ids stay.
        partial: The brain whose session continues; its activity, time and odometry are kept.
        match: Match of the two maps.

    Raises:
        MapError: If the match names experiences that do not exist.
    """
    report = MergeReport(
        False, "", None,
        [session.name for session in loaded.sessions.sessions],
        [session.name for session in partial.sessions.sessions],
    )  # fmt: skip
    apart = differing(loaded, partial)
    if apart:
        report.reason = f"the maps have different configs: {'; '.join(apart)}"
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
        merged.reset_links()  # a merged place cell has the position of the loaded one
        state |= {f"map.{name}": value for name, value in merged.state_dict().items()}
    _describe(report, loaded, partial, merged, match, join)
    strain, allowed = _strain(report, loaded.map, partial, merged, join)
    if strain > allowed and partial.config.sessions.check_residuals:
        report.reason = (
            f"the merged map is inconsistent: its strained links have a residual of "
            f"{strain:.3f} m (RMS) after relaxation; expected at most {allowed:.3f} m"
        )
        return Merged(None, join, report)
    report.merged = True
    new = merged.n - loaded.map.n
    report.reason = (
        f"{counted(new, 'experience is', 'experiences are')} new" if new else "no experience is new"
    )
    return Merged(state, join, report)


def _beyond_odometry(loaded: Mapped, partial: Mapped, match: Match) -> str:
    """Return why the pairs of a match exceed the drift of odometry; empty if they do not."""
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
        f"by the match they are {off_m[worst]:.2f} m apart; expected at most "
        f"{allowed_m[worst]:.2f} m of odometry drift"
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
    # Shifts from minus half to half of the torus are easier to read.
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
    """Relax a copy of the merged map; return the RMS residual of strained links and its limit."""
    new = links_kept(partial.map.links, loaded.links, join)
    before = np.concatenate([loaded.residuals_m, partial.map.residuals_m[new]])
    trial = deepcopy(merged)
    loops = min(max(_CHECK_STEPS // max(1, len(before)), 100), 5000)
    if len(join.kept_experiences) < len(join.experiences) - 1:  # one experience strains nothing
        trial.relax(loops)
    after, length = trial.residuals_m, trial.links.distance_m
    report.residual_before_m, report.residual_after_m = _rms(before), _rms(after)
    moved = trial.poses[:, :2] - merged.poses[:, :2]
    report.largest_correction_m = float(np.hypot(*moved.T).max())
    strained = (after > before) & (after > _STRAINED * length)
    factor = partial.config.sessions.residual_factor
    allowed = max(factor * _rms(before[strained]), _TORN * _rms(length[strained]))
    return _rms(after[strained]), allowed


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
