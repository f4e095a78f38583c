"""Two states of brains become one: how ids and coordinates change, and every part by its rule."""

from collections.abc import Mapping

import numpy as np
import torch

from neuroslam.config import BrainConfig
from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angle
from neuroslam.state.join import Join, MovedCells
from neuroslam.state.match import Match, Pairs
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.population import Population
from neuroslam.types import NO_TEMPLATE, Pose


def make_join(
    loaded: State,
    partial: State,
    match: Match,
    config: BrainConfig,
    parts: Mapping[str, Mergeable],
) -> Join:
    r"""Work out how ids and coordinates change.

    .. math:: \Delta = P_u - P_z + (0, 0, \rho), \qquad \Delta\theta = \theta_u - \theta_z + \rho

    with :math:`\rho` the turn of the match. Each further pair of equal experiences becomes one
    too; their views become one view.

    Args:
        loaded: State of the brain that is merged into.
        partial: State of the brain whose session goes on.
        match: Where they meet.
        config: Of both.
        parts: Of such a brain by name; its populations say how cells and their frames move.

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
    n_views = len(loaded["view.templates.pixels"])
    view_turns, view_ids = _fold_views(
        views["partial"][pairs.partial], views["loaded"][pairs.loaded], pairs,
        len(partial["view.templates.pixels"]),
    )  # fmt: skip
    n_loaded, n_partial = len(places["loaded"]), len(places["partial"])
    experiences = _numbered(n_partial, n_loaded, pairs.partial, pairs.loaded)
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    pivot = Pose(*places["partial"][match.partial].tolist())
    x, y, theta = places["loaded"][match.loaded].tolist()
    populations = {name: p for name, p in parts.items() if isinstance(p, Population)}
    moved = [p.moved_cells(loaded, partial, match, config) for p in populations.values()]
    cell_moves = next((found for found in moved if found is not None), None) or MovedCells(
        np.zeros(3), np.zeros((len(view_ids), 3)), partial["map.experiences.cell"].numpy()
    )
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
        cell_shift=tuple(cell_moves.shift.tolist()),
        view_cells=cell_moves.views,
        experience_cells=cell_moves.experiences,
        pivot=pivot,
        onto=match.onto or Pose(x, y, wrap_angle(theta + match.turn_rad)),
    )  # fmt: skip
    frames = [
        population.frames(part_of(loaded, name), part_of(partial, name), join)
        for name, population in populations.items()
    ]
    return join._replace(cells=next((found for found in frames if found is not None), None))


def part_of(state: State, name: str) -> State:
    """Return the state of one part of a brain, without its prefix."""
    return {key.removeprefix(f"{name}."): value for key, value in state.items()
            if key.startswith(f"{name}.")}  # fmt: skip


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
    parts: Mapping[str, Mergeable],
) -> tuple[State, Join]:
    """Merge two state dicts of brains into one; a pure function, neither is altered.

    The session that goes on is the partial one. Each part merges by its own rule,
    :meth:`~neuroslam.state.mergeable.Mergeable.merged`; stored maps are left out.

    Args:
        loaded: ``state_dict`` of the brain that is merged into.
        partial: ``state_dict`` of the brain whose session goes on.
        match: Where they meet.
        config: Of both.
        parts: Of such a brain by name, for their rules.

    Returns:
        The ``state_dict`` of the merged brain, and how the partial one's ids and poses changed.

    Raises:
        MapError: If the match names places that are not there, or a part of the state has no rule.
    """
    join = make_join(loaded, partial, match, config, parts)
    merged: State = {}
    for name, part in parts.items():
        one, other = part_of(loaded, name), part_of(partial, name)
        with torch.no_grad():
            result = part.merged(one, other, join)
        if set(result) != set(other):
            missing = sorted(set(result) ^ set(other))
            raise MapError(f"merge: {name} has no rule for {', '.join(missing)}")
        merged |= {f"{name}.{key}": value for key, value in result.items()}
    forgotten = sorted(
        key for key in partial if key not in merged and not key.startswith("stored.")
    )
    if forgotten:
        raise MapError(f"merge: nothing says how {forgotten[0]} merges; add a Mergeable")
    return merged, join
