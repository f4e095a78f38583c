"""Merge of the navigation cells of two sessions."""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.boundary_vectors import squared_mismatch, wrap
from neuroslam.cells.grid import lahn_drive
from neuroslam.cells.oscillators import turn_phases, wave_vectors
from neuroslam.cells.place import EMPTY, FAR_M, NEIGHBOURS
from neuroslam.errors import listed
from neuroslam.geometry import TWO_PI, rotation_matrix, wrap_angle
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State
from neuroslam.types import Pose


class Frames(NamedTuple):
    """Alignment of the partial frame with the loaded one: rotation about a point, then shift.

    Attributes:
        pivot: A pose in the partial session's frame.
        onto: The same pose in the loaded one's.
    """

    pivot: Pose
    onto: Pose

    @property
    def turn_rad(self) -> float:
        """Rotation of the partial session."""
        return wrap_angle(self.onto.theta_rad - self.pivot.theta_rad)

    def place(self, points_m: Tensor) -> Tensor:
        """Move points, ``(n, 2)``.

        Example:
            >>> frames = Frames(Pose(1.0, 0.0, 0.0), Pose(5.0, 5.0, math.pi / 2))
            >>> frames.place(torch.tensor([[2.0, 0.0]])).tolist()
            [[5.0, 6.0]]
        """
        turn = points_m.new_tensor(rotation_matrix(self.turn_rad))
        start = points_m.new_tensor(self.pivot[:2])
        return (points_m - start) @ turn.mT + points_m.new_tensor(self.onto[:2])


def join_navigation(loaded: State, partial: State, join: Join) -> State:
    """Merge the states of navigation cells; neither is altered.

    Place cells nearer to each other than ``threshold_m`` become one, and their visits add; if each
    is an experience of the map, those become one whose experiences do. Wall segments that both
    remember become one. The partial session's position and phases move.

    Args:
        loaded: State of the map that is merged into; its ids stay.
        partial: State of the session that goes on.
        join: How ids of views and experiences change.
    """
    frames = Frames(*(join.cells or (join.pivot, join.onto)))
    mapped = len(join.experiences) == int(partial["place.n_cells"][0]) and not len(join.views)
    ids = join.experiences if mapped else _same_places(loaded, partial, frames)
    merged = {name: value for name, value in partial.items() if name not in loaded}
    merged |= {n: v for n, v in partial.items() if n.startswith(("boundary.", "now."))}
    merged |= _join_grid(loaded, partial, frames)
    merged |= _join_places(loaded, partial, ids, frames)
    merged |= _join_familiarity(loaded, partial, ids, frames)
    merged |= _join_walls(loaded, partial, frames)
    merged |= _join_views(loaded, partial, join, frames)
    turned = frames.turn_rad
    merged["now.heading_rad"] = partial["now.heading_rad"] + turned
    merged["now.turned_rad"] = partial["now.turned_rad"] + turned
    merged["now.views_agree"] = torch.zeros_like(partial["now.views_agree"])
    last = int(partial["now.last_view"])
    if last >= 0:
        merged["now.last_view"] = partial["now.last_view"].new_tensor(int(join.views[last]))
    return merged


def view_frames(loaded: State, partial: State, join: Join) -> tuple[Pose, Pose] | None:
    """Align the frames of two sessions by the views that both know.

    Returns:
        A pose in the partial frame, and the same in the loaded one; ``None`` if both animals were
        lost when they learnt those views.
    """
    same = np.flatnonzero(join.views < join.n_views)
    rows = [_seen(partial)[same], _seen(loaded)[join.views[same]]]
    sure = (rows[0][:, 3] > 0) & (rows[1][:, 3] > 0)
    if not sure.any():
        return None
    one, other = rows[0][sure], rows[1][sure]
    turns = other[:, 2] - one[:, 2] + join.view_turns_rad[same][sure]
    turn = math.atan2(np.sin(turns).mean(), np.cos(turns).mean())
    middle, onto = one[:, :2].mean(0), other[:, :2].mean(0)
    return Pose(float(middle[0]), float(middle[1]), 0.0), Pose(float(onto[0]), float(onto[1]), turn)


def _seen(state: State) -> np.ndarray:
    names = ("x_m", "y_m", "heading_rad", "sure")
    return np.column_stack([state[f"seen.{name}"].numpy() for name in names])


def _same_places(loaded: State, partial: State, frames: Frames) -> np.ndarray:
    """Return the number of every partial place cell in the merged table, by distance."""
    n, m = (int(state["place.n_cells"][0]) for state in (loaded, partial))
    ids = n + np.arange(m)
    if n and m:
        from scipy.spatial import KDTree  # slow to import, not always needed

        threshold = float(loaded["place.threshold_m"])
        moved = frames.place(partial["place.centres_m"][0, :m])
        away, nearest = KDTree(loaded["place.centres_m"][0, :n].numpy()).query(moved.numpy())
        ids = np.where(away < threshold, nearest, -1)
        ids[ids < 0] = n + np.arange((ids < 0).sum())
    return ids


def _join_grid(loaded: State, partial: State, frames: Frames) -> State:
    """Keep the loaded network, to which its place cells are tuned; set phases to the position."""
    merged = {n: v for n, v in loaded.items() if n.startswith(("grid.", "oscillators."))}
    position = frames.place(partial["oscillators.position_m"][None])[0]
    merged["oscillators.position_m"] = position
    merged["oscillators.phases"] = _phases(loaded, position)
    merged["grid.rates"] = _grid_rates(loaded, position[None])[0]
    return merged


def _phases(state: State, at_m: Tensor) -> Tensor:
    waves = _waves(state)
    start = torch.zeros(*at_m.shape[:-1], *waves.shape, dtype=waves.dtype)
    start[..., 0] = 1.0
    return turn_phases(waves, at_m, start)


def _waves(state: State) -> Tensor:
    directions = state["oscillators.phases"].shape[-2]
    return wave_vectors(
        state["oscillators.spacing_m"], state["oscillators.orientation_rad"], directions
    )


def _grid_rates(state: State, at_m: Tensor) -> Tensor:
    """Return the settled rates of the network at positions, ``(n, n_modules, n_cells)``."""
    inputs = _phases(state, at_m).flatten(-2).to(state["grid.bias"])
    rates = torch.zeros(len(at_m), *state["grid.bias"].shape)
    for _ in range(_SETTLING_STEPS):
        drive = lahn_drive(inputs, rates, state["grid.feedforward"], state["grid.lateral"])
        rates = (drive - state["grid.bias"]).clamp_min(0.0)
    return rates


_SETTLING_STEPS = 4


def _join_places(loaded: State, partial: State, ids: np.ndarray, frames: Frames) -> State:
    n, m = (int(state["place.n_cells"][0]) for state in (loaded, partial))
    to = torch.from_numpy(ids)
    total = max(n, int(ids.max(initial=-1)) + 1)
    new = to >= n
    room = max(total, loaded["place.weights"].shape[1])
    merged = {k: v for k, v in partial.items() if k.startswith("place.")}
    for name, empty in EMPTY.items():
        table = loaded[f"place.{name}"]
        grown = table.new_full((1, room, *table.shape[2:]), empty)
        grown[:, :n] = table[:, :n]
        merged[f"place.{name}"] = grown
    centres = frames.place(partial["place.centres_m"][0, :m])
    merged["place.centres_m"][0, to[new]] = centres[new]
    if bool(new.any()):
        codes = _grid_rates(loaded, centres[new]).flatten(1)
        merged["place.weights"][0, to[new]] = torch.nn.functional.normalize(codes, dim=-1)
    for name in ("visits", "time_s"):
        merged[f"place.{name}"][0].index_add_(0, to, partial[f"place.{name}"][0, :m])
    merged["place.neighbours"][0] = _join_neighbours(
        merged["place.neighbours"][0], partial["place.neighbours"][0, :m], to
    )
    merged["place.n_cells"] = torch.tensor([total])
    winner = int(partial["place.winner"][0])
    merged["place.winner"] = torch.tensor([int(ids[winner]) if winner >= 0 else -1])
    merged["place.window"] = torch.arange(merged["place.window"].shape[1])[None]
    merged["place.landmarks_m"] = torch.full_like(merged["place.landmarks_m"], FAR_M)
    return merged


def _join_neighbours(table: Tensor, partial: Tensor, to: Tensor) -> Tensor:
    links = [set(row) - {-1} for row in table.tolist()]
    for cell, row in zip(to.tolist(), partial.tolist(), strict=True):
        links[cell] |= {int(to[k]) for k in row if k >= 0} - {cell}
    rows = [sorted(row)[:NEIGHBOURS] for row in links]
    return torch.tensor([row + [-1] * (NEIGHBOURS - len(row)) for row in rows])


def _join_familiarity(loaded: State, partial: State, ids: np.ndarray, frames: Frames) -> State:
    room = max(loaded["familiarity.time_s"].shape[1], int(ids.max(initial=-1)) + 1)
    bins = loaded["familiarity.felt_s"].shape[-1]
    by = round(frames.turn_rad * bins / TWO_PI)
    merged = {k: v for k, v in partial.items() if k.startswith("familiarity.")}
    for name in ("felt_s", "time_s"):
        table, more = loaded[f"familiarity.{name}"], partial[f"familiarity.{name}"][0]
        more = more[: len(ids)]
        grown = table.new_zeros((1, room, *table.shape[2:]))
        grown[:, : table.shape[1]] = table
        if name == "felt_s":
            more = more.roll(by, -1)
        grown[0].index_add_(0, torch.from_numpy(ids[: len(more)]), more)
        merged[f"familiarity.{name}"] = grown
    return merged


def _join_walls(loaded: State, partial: State, frames: Frames) -> State:
    """Put the loaded walls first; a partial wall that matches one of them becomes it."""
    merged = {k: v for k, v in partial.items() if k.startswith("walls.")}
    n, m = (int(state["walls.n_walls"][0]) for state in (loaded, partial))
    one, other = loaded["walls.walls"][0, :n].clone(), partial["walls.walls"][0, :m].clone()
    one[:, 5] -= loaded["walls.since.time_s"]  # before the start of the session that goes on
    other[:, :2] = frames.place(other[:, :2])
    other[:, 2] = wrap(other[:, 2] + frames.turn_rad)
    to = n + torch.arange(m)
    if n and m:
        pairs = squared_mismatch(one, other[:, None, :2], other[:, None, 2], loaded["walls.scale"])
        mismatch, nearest = pairs.min(1)
        # Each loaded wall matches at most one, that of least mismatch; the others stay.
        order = mismatch.argsort()
        taken: set[int] = set()
        for k in order.tolist():
            wall = int(nearest[k])
            if mismatch[k] < 1.0 and wall not in taken:
                taken.add(wall)
                to[k] = wall
    kept = (to >= n).nonzero()[:, 0]
    to[kept] = n + torch.arange(len(kept))
    merged["walls.walls"] = torch.cat([one, other[kept]])[None]
    merged["walls.n_walls"] = torch.tensor([n + len(kept)])
    active = partial["walls.active"]
    merged["walls.active"] = torch.where(active >= 0, to[active.clamp_min(0)], -1)
    turn = torch.eye(partial["walls.covariance"].shape[-1], dtype=torch.float64)
    turn[:2, :2] = torch.from_numpy(rotation_matrix(frames.turn_rad))
    merged["walls.covariance"] = turn @ partial["walls.covariance"] @ turn.mT
    merged["walls.moved_m"] = partial["walls.moved_m"] @ turn[:2, :2].mT
    return merged


def _join_views(loaded: State, partial: State, join: Join, frames: Frames) -> State:
    kept = torch.from_numpy(join.kept_views)
    rows = {name: partial[f"seen.{name}"][kept] for name in ("x_m", "y_m", "heading_rad", "sure")}
    at = frames.place(torch.stack([rows["x_m"], rows["y_m"]], dim=1))
    rows["x_m"], rows["y_m"] = at[:, 0], at[:, 1]
    rows["heading_rad"] = rows["heading_rad"] + frames.turn_rad
    return {f"seen.{name}": torch.cat([loaded[f"seen.{name}"], row]) for name, row in rows.items()}


def navigation_faults(state: Mapping[str, np.ndarray], n_experiences: int | None) -> Iterator[str]:
    """Yield what is invalid in a state of navigation cells.

    Args:
        state: State of the cells, as arrays.
        n_experiences: Number of experiences, if each place cell is one; ``None``: they are not.
    """
    n_cells, n_walls = (int(state[name][0]) for name in ("place.n_cells", "walls.n_walls"))
    if n_experiences not in (None, n_cells):
        yield f"{n_cells} place cells, {n_experiences} experiences; expected one for each"
    linked = state["place.neighbours"][0, :n_cells]
    rows = np.unique(np.nonzero((linked < -1) | (linked >= n_cells))[0])
    if len(rows):
        yield f"place cells {listed(rows)}: linked to cells that do not exist; there are {n_cells}"
    norms = np.linalg.norm(state["place.weights"][0, :n_cells], axis=1)
    rows = np.flatnonzero(np.abs(norms - 1.0) > 1e-3)
    if len(rows):
        yield f"place cells {listed(rows)}: weights of norm {listed(norms[rows])}, expected 1"
    active = state["walls.active"][0]
    rows = np.flatnonzero((active < -1) | (active >= n_walls))
    if len(rows):
        yield f"active walls {listed(rows)}: not remembered; there are {n_walls}"
    if (np.diag(state["walls.covariance"][0]) < 0).any():
        yield "navigation.walls.covariance: a variance is negative"
