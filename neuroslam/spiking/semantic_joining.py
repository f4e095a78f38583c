"""Merge of the landmarks of two sessions."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

import numpy as np
import torch

from neuroslam.config.semantic import SemanticConfig
from neuroslam.geometry import rotate_points, rotation_matrix, wrap_angle
from neuroslam.spiking.sightings import LEAST_SEEN, NAMELESS, VIEW
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.spiking.vocabulary import SemanticState, Vocabulary, WordTable, landmark_pointer
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State
from neuroslam.types import Pose


class LandmarkCells(Protocol):
    """What a merge uses of :class:`~neuroslam.spiking.semantic.SemanticCells`."""

    config: SemanticConfig
    follows: Literal["nothing", "map", "cells"]
    known: Vocabulary
    words: WordTable
    slam: SSPSLAM
    now: SemanticState

    @property
    def pose(self) -> Pose:
        """Pose of the robot."""
        ...

    def moved(self, points_m: np.ndarray, join: Join) -> np.ndarray:
        """Move positions of the partial session into the loaded frame."""
        ...

    def covariances(self) -> np.ndarray | None:
        """Return the covariances of the recalled positions; ``None`` if they are exact."""
        ...

    def write_memory(self, covariance_m2: np.ndarray | None = None) -> None:
        """Rewrite the memory from ``known``."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> object:
        """Load a state."""

    def state_dict(self) -> State:
        """Return the state."""
        ...


@torch.no_grad()
def merge_landmarks(
    make: Callable[[], LandmarkCells], loaded: State, partial: State, join: Join
) -> State:
    """Merge the landmarks of two sessions in the frame of the loaded one, into a new memory.

    Landmarks of the same name become one, views as in the merge of the maps, nameless ones by
    position. Where the positions or words differ, those of the partial session, the later one,
    hold; but a landmark that was not seen often enough to be no outlier moves none that was.

    Args:
        make: Makes empty semantic cells like those that merge.
        loaded: State of the loaded session.
        partial: State of the session that goes on.
        join: How ids and coordinates of the partial session change.
    """
    one, other, merged = (make() for _ in range(3))
    one.load_state_dict(loaded)
    other.load_state_dict(partial)
    there = other.moved(other.known["place_m"].numpy(), join)
    keys = {key: row for row, key in enumerate(one.known.row_of)}
    columns: dict[str, list[Any]] = {c: one.known[c].tolist() for c in one.known.columns}
    free = sum(kind == NAMELESS for kind, _ in keys)
    ours, added = _spreads(one, other, join)
    evidence, more = _evidence(one), _evidence(other)
    for row, (kind, number) in enumerate(other.known.row_of):
        if kind == VIEW:
            number = int(join.views[number])
        elif kind == NAMELESS:
            number, free = _same_nameless(one, there[row], free)
        theirs: dict[str, Any] = {c: other.known[c][row].tolist() for c in columns}
        at = keys.get((kind, number))
        if theirs["experience"] >= 0:
            theirs["experience"] = int(join.experiences[theirs["experience"]])
            turn = float(join.turns_rad[other.known["experience"][row]])
            theirs["offset_m"] = rotate_points(np.array(theirs["offset_m"]), turn).tolist()
        if at is None:
            keys[kind, number] = len(columns["kind"])
            for c, value in (theirs | {"number": number, "place_m": there[row].tolist()}).items():
                columns[c].append(value)
            ours.append(added[row])
            evidence.append(more[row])
            continue
        mine = np.array(columns["place_m"][at])
        agree = np.linalg.norm(mine - there[row]) < one.config.same_m
        if agree:
            columns["place_m"][at] = ((mine + there[row]) / 2).tolist()
            ours[at] = (ours[at] + added[row]) / 2 + np.outer(*[mine - there[row]] * 2) / 4
        elif theirs["seen"] >= LEAST_SEEN or columns["seen"][at] < LEAST_SEEN:
            columns["place_m"][at] = there[row].tolist()
            ours[at] = added[row]
        evidence[at] += more[row]
        columns["seen"][at] += theirs["seen"]
        columns["variance_m2"][at] = min(columns["variance_m2"][at], theirs["variance_m2"])
    for cells in (one, other):
        merged.words.update(cells.words.entries)
    certainty = (np.array(ours), evidence) if one.config.has_uncertain_sightings else None
    return _written(merged, other, columns, certainty, join)


def _spreads(
    one: LandmarkCells, other: LandmarkCells, join: Join
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the covariances of both sessions' landmarks in the loaded frame; 0 if exact."""
    each = []
    for cells in (one, other):
        spread = cells.covariances()
        each.append(np.zeros((len(cells.known), 2, 2)) if spread is None else spread)
    turn = rotation_matrix(_turn(other, join))
    return list(each[0]), list(turn @ each[1] @ turn.T)


def _evidence(cells: LandmarkCells) -> list[float]:
    """Return the time for which each landmark was learnt, by its certainty; 0 if exact."""
    n = len(cells.known)
    return (
        cells.slam.evidence_s[0, :n].tolist() if cells.config.has_uncertain_sightings else [0] * n
    )


def _turn(session: LandmarkCells, join: Join) -> float:
    """Return by how much a partial session's positions turn."""
    return join.rotation_rad if session.follows == "map" else join.cells_turn_rad


def _written(
    merged: LandmarkCells,
    session: LandmarkCells,
    columns: dict[str, list[Any]],
    certainty: tuple[np.ndarray, list[float]] | None,
    join: Join,
) -> State:
    """Write landmarks into new cells, which continue the partial session; return their state."""
    dtypes = {c: session.known[c].dtype for c in columns}
    shape = {c: session.known[c].shape[1:] for c in columns}
    merged.known.replace(
        **{c: torch.tensor(v, dtype=dtypes[c]).reshape(-1, *shape[c]) for c, v in columns.items()}
    )
    merged.known.index()
    slam = merged.slam
    if merged.known.row_of:
        pointers = torch.stack(
            [landmark_pointer(merged.config, *key) for key in merged.known.row_of]
        )
        names = [merged.words.name_of(*key) for key in merged.known.row_of]
        slam.know(pointers.to(slam.pointers), names)
        if certainty is None:
            merged.write_memory()
        else:
            spread, evidence = certainty
            merged.write_memory(spread)
            slam.evidence_s = slam.evidence_s.new_tensor([evidence])
    now = session.moved(np.array([session.pose[:2]]), join)[0]
    slam.time_s = session.slam.time_s.clone()
    slam.start(torch.tensor(now[None]))
    for name in session.now.kinds:
        setattr(merged.now, name, getattr(session.now, name))
    merged.now.heading_rad = wrap_angle(session.now.heading_rad + _turn(session, join))
    merged.now.told = -1
    return merged.state_dict()


def _same_nameless(one: LandmarkCells, place_m: np.ndarray, free: int) -> tuple[int, int]:
    """Return the number of a nameless landmark in a merge, and the next free number."""
    row, _ = one.known.nearest_nameless(place_m, one.config.same_m)
    return (int(one.known["number"][row]), free) if row >= 0 else (free, free + 1)
