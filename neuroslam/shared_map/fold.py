r"""The fold: one map from the set of all offers, whatever their order.

Every robot's connected places make a map of their own, solved from its links. Starting with the
largest, each is matched by its views with the groups of maps there are (see
:mod:`neuroslam.merging.match`), and merged with the first whose residuals stay within what the
noise of odometry explains (:mod:`neuroslam.merging.consistency`); then the groups are matched with
each other until none merge. The group of most robots is the shared map. The rest is in quarantine,
with its reason, until later offers confirm it: a robot with wrong odometry, or on another floor,
does not move a place of the map.

The poses of the shared map are those of the least squares over all links, with the standard
deviations :math:`\sigma_k` of :func:`~neuroslam.merging.consistency.link_sigmas`,

.. math:: \hat p = \arg\min_p \sum_k \lVert r_k(p) / \sigma_k \rVert^2

Orders are by session and number and the solver is deterministic, so equal sets give equal maps.
"""

import json
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import MapError, SharedMapError, counted
from neuroslam.geometry import compose_poses, wrap_angles
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.merging.consistency import link_sigmas
from neuroslam.merging.match import find_match
from neuroslam.merging.shape import misshapen
from neuroslam.shared_map.journal import Entry, Layout
from neuroslam.shared_map.messages import decode
from neuroslam.shared_map.records import Piece, Records
from neuroslam.state.sessions import Session, session_name
from neuroslam.threads import limit_threads, usable_threads
from neuroslam.view.search import template_blocks

LAYOUT = np.dtype(
    [("session", "<u8"), ("number", "<u4"), ("experience", "<u4"), ("pose", "<f4", 3)]
)
"""Record of a place on the shared map: of which session and number, experience, and pose."""

LEAST_PLACES = 3
"""Places from which a piece is tried: fewer cannot be confirmed."""

SHAPE = 0.05
"""Largest deviation of the shapes of a common path, as a share of its extent: among robots a noisy
one must not be excused by its own noise. See :mod:`neuroslam.merging.shape`."""

MOST_LAYOUT_BYTES = 2**28

ITERATIONS = 50


class Folded(NamedTuple):
    """The shared map and what is not part of it.

    Attributes:
        digest: Digest of the set of offers.
        brain: The map; ``None`` without places.
        robots: Robots whose places are part of it, in order.
        quarantine: For each piece that is not: robot, sessions, places and reason.
        merges: Reports of the merges.
        layout: Where each place lies that any robot made, records of :data:`LAYOUT`.
    """

    digest: str
    brain: NavigationBrain | None
    robots: tuple[str, ...]
    quarantine: list[dict[str, Any]]
    merges: list[dict[str, Any]]
    layout: np.ndarray

    def to_dict(self) -> dict[str, Any]:
        """Return what is known about the map as plain values."""
        map_ = None if self.brain is None else self.brain.map
        return {
            "digest": self.digest,
            "places": 0 if map_ is None else map_.n,
            "links": 0 if map_ is None else map_.n_links,
            "places_offered_and_confirmed": len(self.layout),
            "robots": list(self.robots),
            "quarantine": self.quarantine,
        }


class _Group(NamedTuple):
    """Maps of robots that are one: the brain, its robots, its pieces."""

    brain: NavigationBrain
    robots: frozenset[str]
    pieces: tuple[Piece, ...]


_Refused = dict[Piece, tuple[int, str]]
"""Piece -> number of robots of the largest group that refused it, and its reason."""

_Tried = set[frozenset[tuple[Piece, ...]]]
"""Pairs of groups that do not merge as they are."""


def gather(entries: Iterable[Entry]) -> Records:
    """Return the set of the offers of a journal."""
    records = Records()
    for entry in entries:
        records.add(entry.robot, decode(entry.message))
    return records


def fold(records: Records, config: BrainConfig) -> Folded:
    """Compute the shared map of a set of offers; see the module.

    Args:
        records: The set; it is not altered.
        config: Config of the journal.
    """
    digest = records.digest()
    waiting: list[dict[str, Any]] = []
    groups: list[_Group] = []
    refused: _Refused = {}
    tried: _Tried = set()
    with limit_threads(usable_threads(config.threads)), torch.inference_mode():
        for piece in records.pieces():
            if piece.fault or len(piece.keys) < LEAST_PLACES:
                few = f"{counted(len(piece.keys), 'place')} alone; its links have not come yet"
                waiting.append(_row(piece, piece.fault or few))
                continue
            try:
                brain = piece_map(records, piece, config)
            except MapError as error:  # links that no poses explain
                waiting.append(_row(piece, f"its links cannot be solved: {error}"))
                continue
            one = _Group(brain, frozenset([piece.robot]), (piece,))
            groups = _placed(one, groups, refused, tried)
        groups = _joined(groups, refused, tried)
        if not groups:
            return Folded(digest, None, (), waiting, [], np.zeros(0, LAYOUT))
        main = groups[0]
        main.brain.view.last.template = _template_here(main.brain)  # a search remembers its last
    apart = [
        _row(piece, refused.get(piece, (0, "no other robot has been there yet"))[1])
        for group in groups[1:]
        for piece in group.pieces
    ]
    merges = list(main.brain.sessions.merges)
    layout = layout_of(main.brain)
    return Folded(digest, main.brain, tuple(sorted(main.robots)), apart + waiting, merges, layout)


def _placed(one: _Group, groups: list[_Group], refused: _Refused, tried: _Tried) -> list[_Group]:
    """Merge a map with the first group that it is consistent with; else it is a group itself."""
    for i, group in enumerate(groups):
        both = _merged(group, one, refused)
        if both is not None:
            return _ordered([*groups[:i], both, *groups[i + 1 :]])
        tried.add(frozenset((group.pieces, one.pieces)))
    return _ordered([*groups, one])


def _joined(groups: list[_Group], refused: _Refused, tried: _Tried) -> list[_Group]:
    """Match groups with each other until none merge: a later one can connect two earlier ones."""
    again = True
    while again:
        again = False
        for i, first in enumerate(groups):
            for j in range(i + 1, len(groups)):
                pair = frozenset((first.pieces, groups[j].pieces))
                if pair in tried:
                    continue
                tried.add(pair)
                both = _merged(first, groups[j], refused)
                if both is not None:
                    rest = [group for k, group in enumerate(groups) if k not in (i, j)]
                    groups, again = _ordered([*rest, both]), True
                    break
            if again:
                break
    return groups


def _ordered(groups: list[_Group]) -> list[_Group]:
    """Sort groups: most robots first, then most places, then the smallest key."""
    return sorted(groups, key=lambda g: (-len(g.robots), -g.brain.map.n, g.pieces[0].keys[0]))


def _merged(group: _Group, one: _Group, refused: _Refused) -> _Group | None:
    found = find_match(group.brain, one.brain)
    reason = found.reason
    if found.match is not None:
        reason = misshapen(
            group.brain.map, one.brain.map, found.match.pairs, one.brain.config,
            shape=SHAPE, strict=True,
        )  # fmt: skip
    if found.match is not None and not reason:
        brain, report = group.brain.merge(one.brain, found.match)
        reason = report.reason
        if brain is not None:
            brain.sessions.merges[-1]["found"] = found.reason
            _solve(brain)
            return _Group(brain, group.robots | one.robots, group.pieces + one.pieces)
    for piece in one.pieces:  # the reason of the largest group that refused it
        robots = sorted(group.robots)
        if len(robots) >= refused.get(piece, (0, ""))[0]:
            more = f" and {len(robots) - 3} more" if len(robots) > 3 else ""
            refused[piece] = len(robots), f"with {', '.join(robots[:3])}{more}: {reason}"
    return None


def _row(piece: Piece, reason: str) -> dict[str, Any]:
    sessions = sorted({session for session, _ in piece.keys})
    return {
        "robot": piece.robot,
        "sessions": [session_name(session) for session in sessions],
        "places": len(piece.keys),
        "reason": reason,
    }


def piece_map(
    records: Records, piece: Piece, config: BrainConfig, *, solved: bool = True
) -> NavigationBrain:
    """Build the map of one piece from its records.

    Args:
        records: The set of offers.
        piece: Places and links of the map; all of them must be in the set.
        config: Config of the shared map.
        solved: Solve its poses; else they are those of the robot that made each place.

    Raises:
        MapError: If its links cannot be solved.
    """
    brain = NavigationBrain(config)
    brain.sessions.sessions += _sessions(records, piece)
    view, map_, cells = brain.view, brain.map, brain.pose_cells
    torus = np.array([config.pose_cells.n_xy, config.pose_cells.n_xy, config.pose_cells.n_theta])
    shape = config.view.template_width, config.view.template_height
    known: dict[int, int] = {}
    ids = {}
    for key in piece.keys:
        place = records.places[key]
        cell = torch.from_numpy(np.mod(np.array(place.cell, dtype=np.float64), torus))
        if place.template not in known:
            pixels = np.frombuffer(records.templates[place.template], np.uint8).reshape(shape)
            row: dict[str, float | torch.Tensor] = {
                "pixels": torch.from_numpy(pixels.reshape(-1).copy()),
                "blocks": torch.from_numpy(template_blocks(pixels, view.geometry)),
            }
            if "values" in view.templates.columns:
                row["values"] = torch.from_numpy(pixels.reshape(-1) / 255.0)
            if "mean" in view.templates.columns:
                row["mean"] = float(pixels.mean() / 255.0)
            known[place.template] = view.templates.append(**row)
            x, y, theta = cell.tolist()
            cells.bindings.append(x=x, y=y, theta=theta, decay=cells.config.active_decay)
        ids[key] = map_.experiences.append(
            pose=torch.tensor(place.pose, dtype=torch.float64), cell=cell,
            template=known[place.template], first_frame=place.first_frame,
            session=key[0], number=key[1],
        )  # fmt: skip
    for ends in piece.links:
        link = records.links[ends]
        map_.links_table.append(source=ids[ends[0]], target=ids[ends[1]], **link._asdict())
    last = brain.sessions.now.id
    state = map_.state
    state.session, state.current = last, map_.n - 1
    state.made = 1 + max(number for session, number in piece.keys if session == last)
    state.facing_rad = float(map_.poses[-1, 2])
    state.at_rest = 0
    view.last.template = _template_here(brain)
    brain.clock.frame = records.places[piece.keys[-1]].first_frame
    brain.clock.frames_seen = sum(session.frames for session in brain.sessions.sessions)
    if solved:
        _solve(brain)
    return brain


def _template_here(brain: NavigationBrain) -> int:
    return int(brain.map.experiences.array("template")[brain.map.current])


def _sessions(records: Records, piece: Piece) -> list[Session]:
    """Return the log of the sessions of a piece; frames are known as far as places were made."""
    frames: dict[int, list[int]] = {}
    for key in piece.keys:
        frames.setdefault(key[0], []).append(records.places[key].first_frame)
    return [
        Session(
            session, records.sources[session], "", "", min(seen), 0.0, max(seen) - min(seen) + 1
        )
        for session, seen in frames.items()
    ]


def _solve(brain: NavigationBrain) -> None:
    """Replace the poses of a map by the least squares over its links.

    Raises:
        MapError: If there is no finite solution.
    """
    map_ = brain.map
    if map_.n_links:
        sigma_m, sigma_rad = link_sigmas(map_.links, brain.config.sessions.residual_factor)
        solved, _ = solve_pose_graph(
            map_.poses, *map_.links[:5], sigma_m=sigma_m, sigma_rad=sigma_rad,
            max_iterations=ITERATIONS,
        )  # fmt: skip
        if not np.isfinite(solved).all():
            raise MapError("the poses are not finite")
        turned = float(solved[map_.current, 2] - map_.poses[map_.current, 2])
        map_.experiences.array("pose")[:] = solved
        map_.state.facing_rad = float(wrap_angles(np.array(map_.state.facing_rad + turned)))
    map_.state.at_rest, map_.state.largest_correction = 1, 0.0


def publication(folded: Folded, upto: int) -> Layout:
    """Pack a fold for :meth:`~neuroslam.shared_map.journal.Journal.publish`.

    Args:
        folded: The fold.
        upto: Number of the last offer that it was computed from.
    """
    report = json.dumps(folded.to_dict())
    return Layout(folded.digest, upto, pack_layout(folded.layout), report)


def layout_of(brain: NavigationBrain) -> np.ndarray:
    """Return where each place lies that any robot made, also those that are one now.

    Returns:
        Records of :data:`LAYOUT`, in order of session and number.
    """
    origins = brain.map.origins()
    offset = np.column_stack([origins.ahead_m, origins.left_m, origins.turn_rad])
    rows = np.zeros(len(offset), LAYOUT)
    rows["session"], rows["number"] = origins.session, origins.number
    rows["experience"] = origins.experience
    rows["pose"] = compose_poses(brain.map.poses[origins.experience], offset)
    return rows[np.lexsort((rows["number"], rows["session"]))]


def pack_layout(layout: np.ndarray) -> bytes:
    """Compress a layout, to publish it."""
    return zlib.compress(np.ascontiguousarray(layout, LAYOUT).tobytes(), 6)


def unpack_layout(packed: bytes) -> np.ndarray:
    """Read a published layout.

    Raises:
        SharedMapError: If it is damaged or too large.

    Example:
        >>> rows = np.zeros(2, LAYOUT)
        >>> len(unpack_layout(pack_layout(rows)))
        2
    """
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(packed, MOST_LAYOUT_BYTES)
        rows = np.frombuffer(raw, LAYOUT)
    except (zlib.error, ValueError) as error:
        raise SharedMapError(f"layout: cannot be read ({error}); fold the map again") from None
    if not unpacker.eof or not np.isfinite(rows["pose"]).all():
        raise SharedMapError("layout: is damaged; fold the map again")
    return rows
