"""Two brains become one: the map of one session joined to that of another where they meet."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from neuroslam.merging.limits import far_off, tolerance
from neuroslam.cells.attractor import moved_cells
from neuroslam.cells.joining import view_frames
from neuroslam.config import BrainConfig
from neuroslam.errors import MapError, counted
from neuroslam.geometry import TWO_PI, wrap_angle
from neuroslam.mapping.joining import links_kept
from neuroslam.mapping.overlap import Pairs
from neuroslam.spiking.landmark_frames import shared_frames
from neuroslam.state.population import Join, Population, State
from neuroslam.types import NO_TEMPLATE, Pose

if TYPE_CHECKING:
    from neuroslam.brain.brain import NavigationBrain

_CHECK_STEPS = 2_000_000
"""Links times loops of the relaxation that tries a merged map: a fraction of a second."""

_PULLED = 0.1
"""A link that relaxation leaves off by more than this share of its length is pulled at."""

_TORN = 0.5
"""Pulled links may be off by this share of their length: odometry may be that wrong."""


class Match(NamedTuple):
    """Where two maps meet.

    Attributes:
        loaded: Experience :math:`e_u` of the loaded map.
        partial: Experience :math:`e_z` of the partial map: the same place.
        turn_rad: Heading of :math:`e_z` minus heading of :math:`e_u`, as the views tell.
        error: Mean difference of the views.
        runner_up: That of the most similar view of any other place, where it was looked for.
        others: Further places that are the same, if any.
        onto: Where :math:`e_z` comes to lie, where that is known better than that it is
            :math:`e_u`.
    """

    loaded: int
    partial: int
    turn_rad: float = 0.0
    error: float = 0.0
    runner_up: float | None = None
    others: Pairs = Pairs.of([])
    onto: Pose | None = None

    @property
    def pairs(self) -> Pairs:
        """All places that are the same, the match first, each partial place once."""
        others = self.others.pick(self.others.partial != self.partial)
        first = Pairs.of([(self.partial, self.loaded, self.turn_rad, self.error)])
        return Pairs(*(np.concatenate(columns) for columns in zip(first, others, strict=True)))


@dataclass
class MergeReport:
    """What a merge did, or why it was refused.

    Attributes:
        merged: Whether the maps were joined.
        reason: Why not, or what it brought.
        at_frame: Frame of the session that goes on, where it was running.
        loaded_sessions: Sessions of the loaded map.
        partial_sessions: Sessions of the partial map.
        match: Ids, frames, likeness of the match and of its runner-up, number of equal places.
        cell_shift: By how many pose cells the partial session moved along x, y, theta.
        rotation_rad: By how much its map turned.
        translation_m: By how much its matched place moved, x and y.
        counts: Views, experiences and links of both maps and of the merged one.
        residual_before_m: RMS over all links of how far they are off, before.
        residual_after_m: The same after the merged map was relaxed, to see.
        largest_correction_m: How far that relaxation moved the place that it moved farthest.
        found: How it was found that the maps meet, where that was looked for.
    """

    merged: bool
    reason: str
    at_frame: int | None = None
    loaded_sessions: list[str] = field(default_factory=list)
    partial_sessions: list[str] = field(default_factory=list)
    match: dict[str, Any] = field(default_factory=dict)
    cell_shift: list[float] = field(default_factory=list)
    rotation_rad: float | None = None
    translation_m: list[float] = field(default_factory=list)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    residual_before_m: float | None = None
    residual_after_m: float | None = None
    largest_correction_m: float | None = None
    found: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, for ``metrics.json``."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Write the report for a reader, a fact a line."""
        lines = [f"{'merged' if self.merged else 'not merged'}: {self.reason}"]
        if self.match:
            m = self.match
            lines.append(
                f"match: place {m['partial_experience']} (frame {m['partial_frame']}) is place "
                f"{m['loaded_experience']} (frame {m['loaded_frame']}), "
                f"{counted(m['places'], 'place agrees', 'places agree')}"
            )
        if self.found:
            lines.append(f"found: {self.found}")
        by_views = self.match and self.match["error"] is not None
        if by_views:
            runner_up = "none" if m["runner_up"] is None else f"{m['runner_up']:.4f}"
            lines.append(f"likeness: view difference {m['error']:.4f}, best elsewhere {runner_up}")
        if self.cell_shift and by_views:
            x, y, theta = self.cell_shift
            lines.append(f"pose cells moved by {x:.2f}, {y:.2f}, {theta:.2f} cells (x, y, theta)")
        if self.rotation_rad is not None:
            x, y = self.translation_m
            lines.append(
                f"map turned by {np.degrees(self.rotation_rad):.1f} degrees, "
                f"matched place moved by {x:.2f}, {y:.2f} m"
            )
        for what, n in self.counts.items():
            into = f" -> {n['merged']}" if "merged" in n else ""
            lines.append(f"{what}: {n['loaded']} + {n['partial']}{into}")
        if self.residual_after_m is not None:
            lines.append(
                f"links off by {self.residual_before_m:.4f} m before, "
                f"{self.residual_after_m:.4f} m after relaxation (RMS); "
                f"largest correction {self.largest_correction_m:.3f} m"
            )
        return lines


def differing_keys(one: BrainConfig, other: BrainConfig) -> list[str]:
    """Name the parameters of views and cells that differ: such brains cannot merge.

    Where the file of a network's weights lies does not matter, see :func:`differing`.

    Example:
        >>> differing_keys(BrainConfig(), BrainConfig(view={"threshold": 0.04}))
        ['view.threshold is 0.05 and 0.04']
    """
    sections = ["view", "pose_cells"]
    if one.cells != other.cells:
        return [f"cells is {'+'.join(one.cells)} and {'+'.join(other.cells)}"]
    if one.has("place"):
        sections += ["boundary_cells", "grid_cells", "place_cells"]
    if one.has("semantic"):
        sections += ["semantic"]
    differing = []
    for section in sections:
        first, second = (getattr(config, section).model_dump() for config in (one, other))
        differing += [
            f"{section}.{key} is {first[key]} and {second[key]}"
            for key in first
            if first[key] != second[key] and (section, key) != ("view", "weights")
        ]
    return differing


def differing(one: "NavigationBrain", other: "NavigationBrain") -> list[str]:
    """Name what keeps two brains from being merged: parameters, or the network of their views."""
    keys = differing_keys(one.config, other.config)
    networks = {brain.view.network_digest for brain in (one, other)} - {0}
    if not keys and len(networks) > 1:
        keys = [f"the weights of {one.config.view.features!r}, by which views were made"]
    return keys


def make_join(loaded: State, partial: State, match: Match, config: BrainConfig) -> Join:
    r"""Work out how ids and coordinates change.

    .. math:: \Delta = P_u - P_z + (0, 0, \rho), \qquad \Delta\theta = \theta_u - \theta_z + \rho

    with :math:`\rho` the turn of the match. Each further pair of equal places becomes one place
    too; their views become one view.

    Raises:
        MapError: If the match names places that are not there.
    """
    pairs = match.pairs
    places = {name: state["map.experiences.pose"] for name, state in _named(loaded, partial)}
    for name, ids in (("loaded", pairs.loaded), ("partial", pairs.partial)):
        wrong = (ids < 0) | (ids >= len(places[name]))
        if wrong.any():
            raise MapError(
                f"merge: the match names place {ids[wrong][0]} of the {name} map; "
                f"it has {len(places[name])}"
            )
    views = {name: state["map.experiences.template"].numpy() for name, state in
             _named(loaded, partial)}  # fmt: skip
    n_views = len(loaded["pose_cells.bindings.x"])
    view_turns, view_ids = _fold_views(
        views["partial"][pairs.partial], views["loaded"][pairs.loaded], pairs,
        len(partial["pose_cells.bindings.x"]),
    )  # fmt: skip
    n_loaded, n_partial = len(places["loaded"]), len(places["partial"])
    experiences = _numbered(n_partial, n_loaded, pairs.partial, pairs.loaded)
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    pivot = Pose(*places["partial"][match.partial].tolist())
    x, y, theta = places["loaded"][match.loaded].tolist()
    shift, view_cells, experience_cells = _move_cells(loaded, partial, match, config)
    turns = np.zeros(len(views["partial"]))
    has_view = views["partial"] != NO_TEMPLATE  # a place without a camera has none
    turns[has_view] = view_turns[views["partial"][has_view]]
    turns[pairs.partial] = pairs.turn_rad
    join = Join(
        views=_numbered(len(view_ids), n_views, np.flatnonzero(view_ids >= 0),
                        view_ids[view_ids >= 0]),
        experiences=experiences,
        view_turns_rad=view_turns,
        turns_rad=turns,
        n_views=n_views,
        n_experiences=n_loaded,
        torus=torus,
        cell_shift=tuple(shift.tolist()),
        view_cells=view_cells,
        experience_cells=experience_cells,
        pivot=pivot,
        onto=match.onto or Pose(x, y, wrap_angle(theta + match.turn_rad)),
    )  # fmt: skip
    return join._replace(cells=_cell_frames(loaded, partial, join, config))


def _cell_frames(
    loaded: State, partial: State, join: Join, config: BrainConfig
) -> tuple[Pose, Pose] | None:
    """Say how the frames of cells lie that keep positions; ``None``: as the maps do."""
    if config.has("place"):
        return view_frames(*(_part_of(s, "navigation") for s in (loaded, partial)), join)
    if config.has("semantic") and not config.has("pose"):
        same_m = config.semantic.same_m
        return shared_frames(*(_part_of(s, "semantic") for s in (loaded, partial)), same_m=same_m)
    return None


def _part_of(state: State, name: str) -> State:
    return {key.removeprefix(f"{name}."): value for key, value in state.items()
            if key.startswith(f"{name}.")}  # fmt: skip


def _move_cells(
    loaded: State, partial: State, match: Match, config: BrainConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    states = partial["map.experiences.cell"].numpy()
    poses = partial["map.experiences.pose"].numpy()
    views = partial["map.experiences.template"].numpy()
    bound = np.column_stack(
        [partial[f"pose_cells.bindings.{name}"] for name in ("x", "y", "theta")]
    )
    pivot = states[match.partial]
    shift = loaded["map.experiences.cell"].numpy()[match.loaded] - pivot
    shift[2] += match.turn_rad * cells.n_theta / TWO_PI
    ways = view_ways = None
    if config.sessions.cells == "none" or not config.has("pose"):
        return np.zeros(3), bound, states
    if config.sessions.cells == "turn":
        angle = TWO_PI * pivot[2] / cells.n_theta - poses[match.partial, 2]
        c, s = np.cos(angle), np.sin(angle)
        dx, dy = ((poses - poses[match.partial])[:, :2] / cells.cell_size_m).T
        ways = np.column_stack([c * dx - s * dy, s * dx + c * dy])
        first = np.full(len(bound), match.partial)
        first[views[::-1]] = np.arange(len(views))[::-1]  # the first experience with each view
        view_ways = ways[first]
    return (
        shift % torus,
        moved_cells(bound, pivot, shift, torus, view_ways),
        moved_cells(states, pivot, shift, torus, ways),
    )


def _named(loaded: State, partial: State) -> tuple[tuple[str, State], tuple[str, State]]:
    return ("loaded", loaded), ("partial", partial)


def _numbered(n: int, first: int, folded: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Ids of ``n`` things that follow ``first`` others, but for those that become one of them."""
    ids = np.full(n, -1, dtype=np.int64)
    ids[folded] = onto
    kept = ids < 0
    ids[kept] = first + np.arange(kept.sum())
    return ids


def _fold_views(
    partial: np.ndarray, loaded: np.ndarray, pairs: Pairs, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Loaded view that each partial one becomes, by its most similar pair; -1 where it stays."""
    ids, turns = np.full(n, -1, dtype=np.int64), np.zeros(n)
    has_view = (partial != NO_TEMPLATE) & (loaded != NO_TEMPLATE)
    partial, loaded, pairs = partial[has_view], loaded[has_view], pairs.pick(has_view)
    best = np.lexsort((pairs.error, np.arange(len(partial)) != 0))[::-1]  # the match wins
    ids[partial[best]], turns[partial[best]] = loaded[best], pairs.turn_rad[best]
    return turns, ids


def merge_states(
    loaded: State,
    partial: State,
    match: Match,
    config: BrainConfig,
    populations: Mapping[str, Population],
) -> tuple[State, Join]:
    """Merge two state dicts of brains into one; a pure function, neither is altered.

    The session that goes on is the partial one. Each population merges by its own rule,
    :meth:`~neuroslam.state.population.Population.merged`; maps that both keep besides are kept.

    Args:
        loaded: ``state_dict`` of the brain that is merged into.
        partial: ``state_dict`` of the brain whose session goes on.
        match: Where they meet.
        config: Of both.
        populations: The parts of such a brain by name, for their rules.

    Returns:
        The ``state_dict`` of the merged brain, and how the partial one's ids and poses changed.

    Raises:
        MapError: If the match names places that are not there, or a part of the state has no rule.
    """
    join = make_join(loaded, partial, match, config)
    merged: State = {}
    for name, population in populations.items():
        states = [_part_of(state, name) for state in (loaded, partial)]
        with torch.no_grad():
            result = population.merged(*states, join)
        if set(result) != set(states[1]):
            missing = sorted(set(result) ^ set(states[1]))
            raise MapError(f"merge: {name} has no rule for {', '.join(missing)}")
        merged |= {f"{name}.{key}": value for key, value in result.items()}
    forgotten = sorted(
        key for key in partial if key not in merged and not key.startswith("stored.")
    )
    if forgotten:
        raise MapError(f"merge: nothing says how {forgotten[0]} merges; add a Population")
    return merged, join


def merge(
    loaded: "NavigationBrain", partial: "NavigationBrain", match: Match
) -> tuple["NavigationBrain | None", MergeReport]:
    """Merge two brains into a new one; neither is altered.

    Before the merged brain is given away, its map is relaxed on a copy. If that leaves the links
    off by much more than they were, the places were not the same, and the merge is refused.

    Args:
        loaded: The brain that is merged into: its ids stay.
        partial: The brain whose session goes on: its packet, time and odometry are kept.
        match: Where they meet.

    Returns:
        The merged brain, or ``None`` where the merge is refused, and the report.

    Raises:
        MapError: If the match names places that are not there.
    """
    report = MergeReport(
        False, "", None,
        [session.name for session in loaded.sessions.sessions],
        [session.name for session in partial.sessions.sessions],
    )  # fmt: skip
    apart = differing(loaded, partial)
    if apart:
        report.reason = f"views or pose cells were made with different configs: {'; '.join(apart)}"
        return None, report
    report.reason = _beyond_odometry(loaded, partial, match)
    if report.reason:
        return None, report
    states = [
        {name: value.cpu() for name, value in brain.state_dict().items()}
        for brain in (loaded, partial)
    ]
    state, join = merge_states(*states, match, partial.config, partial.populations())
    merged = type(partial)(partial.config)
    merged.take(state, [*map(deepcopy, loaded.stored), *map(deepcopy, partial.stored)])
    merged.to(partial.pose_cells.window.device)
    if not merged.config.has("pose"):
        merged.map.measure_links()  # a place cell that became another's lies where that does
    _describe(report, loaded, partial, merged, match, join)
    strain, allowed = _strain(report, loaded, partial, merged, join)
    if strain > allowed:
        report.reason = (
            f"the merged map contradicts itself: where it pulls, links would be off by "
            f"{strain:.3f} m, at most {allowed:.3f} m is allowed"
        )
        return None, report
    report.merged = True
    places = report.counts["experiences"]
    new = places["merged"] - places["loaded"]
    report.reason = (
        f"{counted(new, 'place is', 'places are')} new"
        if new
        else "nothing is new: the place was known"
    )
    merged.sessions.merges.append(report.to_dict())
    return merged, report


def _beyond_odometry(loaded: "NavigationBrain", partial: "NavigationBrain", match: Match) -> str:
    """Say which of the places that are said to be the same odometry cannot have so far apart."""
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
        f"places {pairs.partial[worst]} and {pairs.loaded[worst]} cannot be the same: laid on the "
        f"match they lie {off_m[worst]:.2f} m apart, odometry may be off by {allowed_m[worst]:.2f}"
    )


def _describe(
    report: MergeReport,
    loaded: "NavigationBrain",
    partial: "NavigationBrain",
    merged: "NavigationBrain",
    match: Match,
    join: Join,
) -> None:
    def place(brain: "NavigationBrain", name: str, experience: int) -> dict[str, int]:
        row = brain.map.experiences
        return {
            f"{name}_experience": experience,
            f"{name}_view": int(row["template"][experience]),
            f"{name}_frame": int(row["first_frame"][experience]),
        }

    report.match = {
        **place(loaded, "loaded", match.loaded),
        **place(partial, "partial", match.partial),
        "error": None if not merged.config.has("pose") else float(match.error),
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
        what: {"loaded": count(loaded), "partial": count(partial), "merged": count(merged)}
        for what, count in (
            ("views", lambda brain: brain.view.n),
            ("experiences", lambda brain: brain.map.n),
            ("links", lambda brain: brain.map.n_links),
        )
    }
    if merged.config.has("place"):
        report.counts |= {
            what: {"loaded": count(loaded), "partial": count(partial), "merged": count(merged)}
            for what, count in (
                ("place cells", lambda brain: int(brain.navigation.place.n_cells)),
                ("walls", lambda brain: int(brain.navigation.walls.n_walls)),
            )
        }
    if merged.config.has("semantic"):
        report.counts["landmarks"] = {
            "loaded": loaded.semantic.n,
            "partial": partial.semantic.n,
            "merged": merged.semantic.n,
        }


def _strain(
    report: MergeReport,
    loaded: "NavigationBrain",
    partial: "NavigationBrain",
    merged: "NavigationBrain",
    join: Join,
) -> tuple[float, float]:
    """Relax a copy of the merged map: how far off are links that it pulls at; how far may they?"""
    new = links_kept(partial.map.links, loaded.map.links, join)
    before = np.concatenate([loaded.map.residuals_m, partial.map.residuals_m[new]])
    tried = deepcopy(merged.map)
    loops = min(max(_CHECK_STEPS // max(1, len(before)), 100), 5000)
    if len(join.kept_experiences) < len(join.experiences) - 1:  # one place only pulls at nothing
        tried.relax(loops)
    after, length = tried.residuals_m, tried.links.distance_m
    report.residual_before_m, report.residual_after_m = _rms(before), _rms(after)
    moved = tried.poses[:, :2] - merged.map.poses[:, :2]
    report.largest_correction_m = float(np.hypot(*moved.T).max())
    pulled = (after > before) & (after > _PULLED * length)
    factor = partial.config.sessions.residual_factor
    return _rms(after[pulled]), max(factor * _rms(before[pulled]), _TORN * _rms(length[pulled]))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
