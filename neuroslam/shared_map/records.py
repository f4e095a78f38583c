r"""The set of offered places, views and links: what a fold is computed from.

Adding offers is commutative, associative and idempotent: records are kept by content, and of two
that contradict each other the one whose bytes are smaller, so the set depends neither on the order
of arrival nor on how often an offer came,

.. math:: S = \bigcup_i O_i
"""

import hashlib
import struct
from collections.abc import Iterable
from typing import NamedTuple

from neuroslam.errors import counted
from neuroslam.shared_map.messages import Offer, template_ids
from neuroslam.state.sessions import session_name

Key = tuple[int, int]
"""Session and number of a place."""


class Place(NamedTuple):
    """A place as its robot made it; poses and cells are those of the robot's own map."""

    first_frame: int
    template: int
    pose: tuple[float, float, float]
    cell: tuple[float, float, float]


class Measured(NamedTuple):
    """Displacement that a robot measured between two places, relative to the first."""

    distance_m: float
    heading_rad: float
    facing_rad: float
    duration_s: float


class Piece(NamedTuple):
    """Places of one robot that its links connect.

    Attributes:
        robot: Name of the robot.
        keys: Its places, in order of session and number.
        links: Ends of its links, in order.
        fault: Why the piece cannot be used; empty if it can.
    """

    robot: str
    keys: tuple[Key, ...]
    links: tuple[tuple[Key, Key], ...]
    fault: str = ""


class Records:
    """Offers as a set.

    Example:
        >>> import numpy as np
        >>> from neuroslam.shared_map.messages import LINK, PLACE
        >>> place = np.zeros(1, PLACE)
        >>> place["number"] = 7
        >>> nothing = np.zeros((0, 4), np.uint8), place, np.zeros(0, LINK)
        >>> records = Records()
        >>> offer = Offer((5,), ("a.mp4",), *nothing)
        >>> records.add("ada", offer), records.add("ada", offer)
        ([(5, 7)], [])
        >>> list(records.places), records.robots
        ([(5, 7)], {5: 'ada'})
    """

    def __init__(self) -> None:
        self.templates: dict[int, bytes] = {}
        self.places: dict[Key, Place] = {}
        self.links: dict[tuple[Key, Key], Measured] = {}
        self.robots: dict[int, str] = {}
        self.sources: dict[int, str] = {}
        self.conflicts: set[int] = set()
        """Sessions of which two places with one number differ."""

    def add(self, robot: str, offer: Offer) -> list[Key]:
        """Add an offer; return its places that were not known."""
        for template, pixels in zip(template_ids(offer.pixels).tolist(), offer.pixels, strict=True):
            row = pixels.tobytes()
            self.templates[template] = min(self.templates.get(template, row), row)
        ids = offer.sessions
        for session, source in zip(ids, offer.sources, strict=True):
            self.sources[session] = min(self.sources.get(session, source), source)
        new = []
        for session, number, first, template, pose, cell in offer.places.tolist():
            key = ids[session], number
            place = Place(first, template, tuple(pose.tolist()), tuple(cell.tolist()))
            owner = self.robots.get(key[0], robot)
            self.robots[key[0]] = min(owner, robot)
            before = self.places.get(key)
            if before is None:
                new.append(key)
            elif before != place:
                self.conflicts.add(key[0])
                place = min(before, place)
            self.places[key] = place
        for a, b, source, target, *rest in offer.links.tolist():
            ends, measured = ((ids[a], source), (ids[b], target)), Measured(*rest)
            self.links[ends] = min(self.links.get(ends, measured), measured)
        return new

    def digest(self) -> str:
        """Return the SHA-256 of the set: equal for equal sets."""
        found = hashlib.sha256()
        for template in sorted(self.templates):
            found.update(self.templates[template])
        for key, place in sorted(self.places.items()):
            numbers = place.first_frame, place.template, *place.pose, *place.cell
            found.update(struct.pack("<QIIQ6f", *key, *numbers))
            found.update(self.robots[key[0]].encode())
        for ends, measured in sorted(self.links.items()):
            found.update(struct.pack("<QIQI4f", *ends[0], *ends[1], *measured))
        for session in sorted(self.sources):
            found.update(f"{session}:{self.sources[session]}:".encode())
        found.update(repr(sorted(self.conflicts)).encode())
        return found.hexdigest()

    def pieces(self) -> list[Piece]:
        """Return the connected pieces of every robot, the largest first; links without ends wait.

        A place whose view has not come yet waits too.
        """
        there = {key for key, place in self.places.items() if place.template in self.templates}
        links = [
            ends
            for ends in sorted(self.links)
            if ends[0] in there
            and ends[1] in there
            and self.robots[ends[0][0]] == self.robots[ends[1][0]]
        ]
        part = _components(sorted(there), links)
        keys: dict[Key, list[Key]] = {}
        own: dict[Key, list[tuple[Key, Key]]] = {}
        for key in sorted(there):
            keys.setdefault(part[key], []).append(key)
        for ends in links:
            own.setdefault(part[ends[0]], []).append(ends)
        found = [
            Piece(
                self.robots[first[0]], tuple(members), tuple(own.get(first, ())),
                self._fault(members),
            )
            for first, members in keys.items()
        ]  # fmt: skip
        return sorted(found, key=lambda piece: (-len(piece.keys), piece.keys[0]))

    def _fault(self, keys: Iterable[Key]) -> str:
        wrong = sorted({session for session, _ in keys} & self.conflicts)
        if not wrong:
            return ""
        return (
            f"{counted(len(wrong), 'session')} with two different places of one number, the first "
            f"{session_name(wrong[0])}: a robot continued two copies of it"
        )


def _components(keys: list[Key], links: list[tuple[Key, Key]]) -> dict[Key, Key]:
    """Return the smallest key of the connected component of each."""
    root = {key: key for key in keys}

    def find(key: Key) -> Key:
        while root[key] != key:
            root[key] = root[root[key]]
            key = root[key]
        return key

    for a, b in links:
        first, second = sorted((find(a), find(b)))
        root[second] = first
    return {key: find(key) for key in keys}
