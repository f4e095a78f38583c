"""Merging of two states: new ids and coordinates, and each part by its rule."""

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
    r"""Compute the changes of ids and coordinates.

    .. math:: \Delta = P_u - P_z + (0, 0, \rho), \qquad \Delta\theta = \theta_u - \theta_z + \rho

    with :math:`\rho` the relative heading of the match. Each further matched pair becomes one
    experience too, and their templates one template.

    Args:
        loaded: State of the brain that is merged into.
        partial: State of the brain whose session continues.
        match: Match of the two maps.
        config: Config of both brains.
        parts: Parts of such a brain by name; its populations compute how cells and frames move.

    Raises:
        MapError: If the match names experiences that do not exist.
    """
    pairs = match.pairs
    poses = {name: state["map.experiences.pose"] for name, state in _named(loaded, partial)}
    for name, ids in (("loaded", pairs.loaded), ("partial", pairs.partial)):
        wrong = (ids < 0) | (ids >= len(poses[name]))
        if wrong.any():
            raise MapError(
                f"merge: the match names experience {ids[wrong][0]} of the {name} map; "
                f"expected 0 to {len(poses[name]) - 1}"
            )
    views = {name: state["map.experiences.template"].numpy() for name, state in
             _named(loaded, partial)}  # fmt: skip
    n_views = len(loaded["view.templates.pixels"])
    view_turns, view_ids = _fold_views(
        views["partial"][pairs.partial], views["loaded"][pairs.loaded], pairs,
        len(partial["view.templates.pixels"]),
    )  # fmt: skip
    n_loaded, n_partial = len(poses["loaded"]), len(poses["partial"])
    experiences = _numbered(n_partial, n_loaded, pairs.partial, pairs.loaded)
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    pivot = Pose(*poses["partial"][match.partial].tolist())
    x, y, theta = poses["loaded"][match.loaded].tolist()
    populations = {name: p for name, p in parts.items() if isinstance(p, Population)}
    moved = [p.moved_cells(loaded, partial, match, config) for p in populations.values()]
    cell_moves = next((found for found in moved if found is not None), None) or MovedCells(
        np.zeros(3), np.zeros((len(view_ids), 3)), partial["map.experiences.cell"].numpy()
    )
    turns = np.zeros(len(views["partial"]))
    has_view = views["partial"] != NO_TEMPLATE  # experiences of a brain without views have none
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
    """Return the ids of ``n`` rows: that of its match, or else the next number from ``first``."""
    ids = np.full(n, -1, dtype=np.int64)
    ids[folded] = onto
    kept = ids < 0
    ids[kept] = first + np.arange(kept.sum())
    return ids


def _fold_views(
    partial: np.ndarray, loaded: np.ndarray, pairs: Pairs, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the turn and the loaded template of each partial one, by its best pair; -1: none."""
    ids, turns = np.full(n, -1, dtype=np.int64), np.zeros(n)
    has_view = (partial != NO_TEMPLATE) & (loaded != NO_TEMPLATE)
    partial, loaded, pairs = partial[has_view], loaded[has_view], pairs.pick(has_view)
    best = np.lexsort((pairs.error, np.arange(len(partial)) != 0))[::-1]  # the match has priority
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

    The partial session continues. Each part merges by its own rule,
    :meth:`~neuroslam.state.mergeable.Mergeable.merged`; stored maps are left out.

    Args:
        loaded: ``state_dict`` of the brain that is merged into.
        partial: ``state_dict`` of the brain whose session continues.
        match: Match of the two maps.
        config: Config of both brains.
        parts: Parts of such a brain by name.

    Returns:
        The ``state_dict`` of the merged brain, and the changes of ids and poses of the partial one.

    Raises:
        MapError: If the match names experiences that do not exist, or a tensor has no merge rule.
    """
    join = make_join(loaded, partial, match, config, parts)
    merged: State = {}
    for name, part in parts.items():
        one, other = part_of(loaded, name), part_of(partial, name)
        with torch.no_grad():
            result = part.merged(one, other, join)
        # Tables that may be empty have no part in a state, and may be in one of the two alone.
        missing = sorted((set(result) - set(one) - set(other)) | (set(other) - set(result)))
        if missing:
            raise MapError(f"merge: {name} has no rule for {', '.join(missing)}; extend merged()")
        merged |= {f"{name}.{key}": value for key, value in result.items()}
    unmerged = sorted(key for key in partial if key not in merged and not key.startswith("stored."))
    if unmerged:
        raise MapError(
            f"merge: no rule for {', '.join(unmerged)}; make it part of a Mergeable of the brain"
        )
    return merged, join
