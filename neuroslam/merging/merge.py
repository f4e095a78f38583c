"""Merging of two sessions: one map from two, aligned by their match."""

from copy import deepcopy
from typing import NamedTuple

import numpy as np

from neuroslam.errors import counted
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.joining import links_kept
from neuroslam.merging.consistency import COLLAPSED, check_consistency, inconsistency
from neuroslam.merging.mapped import SAME_CONFIG, Mapped, differing
from neuroslam.merging.report import MergeReport
from neuroslam.merging.shape import misshapen
from neuroslam.merging.states import merge_states, part_of
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State
from neuroslam.state.population import Population

_CHECK_STEPS = 2_000_000
"""Links times loops of the trial relaxation of a merged map: a fraction of a second."""


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

    If the matched pairs raise the residuals of the links by more than the noise of odometry can
    explain, the matched experiences were not the same, and the merge is refused; see
    :mod:`neuroslam.merging.consistency`. It is also refused if the common path has another shape on
    the two maps; see :mod:`neuroslam.merging.shape`.

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
        report.reason = f"the maps have different configs: {'; '.join(apart)}; {SAME_CONFIG}"
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
    _describe_residuals(report, loaded.map, partial, merged, join)
    if partial.config.sessions.check_residuals and partial.leader.relaxes_map:
        result = check_consistency(
            loaded.map, partial.map, match.pairs, partial.config, robust=False
        )
        report.reason = inconsistency(result)
        if not report.reason and max(result.own) <= COLLAPSED:
            report.reason = misshapen(loaded.map, partial.map, match.pairs, partial.config)
        if report.reason:
            return Merged(None, join, report)
    for name, population in partial.parts().items():
        if partial.config.sessions.check_residuals and isinstance(population, Population):
            report.reason = population.contradicts(
                part_of(one, name), part_of(other, name), match.pairs
            )
            if report.reason:
                return Merged(None, join, report)
    report.merged = True
    new = merged.n - loaded.map.n
    report.reason = (
        f"{counted(new, 'experience is', 'experiences are')} new" if new else "no experience is new"
    )
    return Merged(state, join, report)


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


def _describe_residuals(
    report: MergeReport, loaded: ExperienceMap, partial: Mapped, merged: ExperienceMap, join: Join
) -> None:
    """Relax a copy of the merged map; report the residuals of links and how far the map moved."""
    new = links_kept(partial.map.links, loaded.links, join)
    before = np.concatenate([loaded.residuals_m, partial.map.residuals_m[new]])
    trial = deepcopy(merged)
    loops = min(max(_CHECK_STEPS // max(1, len(before)), 100), 5000)
    if len(join.kept_experiences) < len(join.experiences) - 1:  # one experience strains nothing
        trial.relax(loops)
    report.residual_before_m, report.residual_after_m = _rms(before), _rms(trial.residuals_m)
    moved = trial.poses[:, :2] - merged.poses[:, :2]
    report.largest_correction_m = float(np.hypot(*moved.T).max())


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
