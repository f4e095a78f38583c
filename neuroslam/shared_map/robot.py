"""A robot's side of a shared map: it offers what is new on its map, and takes places of others."""

import json
from typing import NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.brain.localise import Localiser
from neuroslam.errors import SharedMapError, counted
from neuroslam.geometry import compose, relative
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.shared_map.fold import LAYOUT, Piece, piece_map, unpack_layout
from neuroslam.shared_map.journal import Offers, Receipt, shared_config
from neuroslam.shared_map.messages import (
    LINK,
    MOST_ROWS,
    PLACE,
    Offer,
    decode,
    encode,
    template_ids,
)
from neuroslam.shared_map.records import Key, Measured, Records
from neuroslam.state.sessions import session_name
from neuroslam.types import NO_TEMPLATE, Pose

MOST_OFFERED = MOST_ROWS // 4
"""Places of one offer; more are offered in several."""


class Recognised(NamedTuple):
    """A place of the shared map that an image resembles most.

    Attributes:
        key: Session and number of the place.
        robot: Robot that made it.
        pose: Where it lies on the shared map.
        error: Match error of the view.
    """

    key: Key
    robot: str
    pose: Pose
    error: float


class LiveRobot:
    """One robot of a shared map; its own brain maps by itself and is never altered by others.

    Args:
        journal: The journal, or a handle of one on another machine.
        brain: The robot's brain; its config must be that of the journal.
        name: Name of the robot; default: its session, so that a repeated drive is the same robot.

    Raises:
        ConfigError: If maps with this config cannot be shared.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from neuroslam import BrainConfig, open_source
        >>> from neuroslam.shared_map.journal import Journal
        >>> brain = NavigationBrain(BrainConfig())
        >>> for frame in open_source("world:corridor?frames_per_lap=110").frames(stop=20):
        ...     result = brain(frame)
        >>> with TemporaryDirectory() as folder, Journal(folder, brain.config) as journal:
        ...     robot = LiveRobot(journal, brain, "ada")
        ...     receipts = robot.offer(), robot.offer()
        >>> receipts[0][0].number, receipts[1]
        (1, [])
    """

    def __init__(self, journal: Offers, brain: NavigationBrain, name: str = "") -> None:
        self.journal, self.brain, self.name = journal, brain, name
        self.config = shared_config(brain.config)
        self.sent_bytes = self.taken_bytes = 0
        self.records = Records()
        self.confirmed: tuple[str, ...] = ()
        self._cursor = 0
        self._fold = ""
        self._templates: set[int] = set()  # offered and acknowledged, as are these
        self._places: set[Key] = set()
        self._links: set[tuple[Key, Key]] = set()
        self._layout = np.zeros(0, LAYOUT)
        self._poses: dict[Key, Pose] = {}
        self._map: NavigationBrain | None = None
        self._keys: list[Key] = []

    # --- what is new here -----------------------------------------------------------------------

    def begin(self) -> None:
        """Take over what the journal has of this robot, before it goes on from a save.

        If the journal knows more of its session than the save, the robot begins a new session: an
        acknowledged place is never replaced.
        """
        self.take()
        state = self.brain.map.state
        theirs = [number for session, number in self.records.places if session == state.session]
        if any(number >= state.made for number in theirs):
            self.brain.start_new_map("gap")

    def news(self) -> Offer:
        """Return what is new on the robot's map since the last acknowledged offer.

        At most :data:`MOST_OFFERED` places; call it again for the rest.
        """
        sessions: list[int] = []
        sources: dict[int, str] = {}
        places, links, pixels = [], [], []
        sent: set[int] = set(self._templates)
        offered: set[Key] = set(self._places)

        def row_of(session: int) -> int:
            if session not in sessions:
                sessions.append(session)
            return sessions.index(session)

        own = _own_sessions(self.brain)
        for one in (self.brain, *self.brain.stored):
            sources |= {session.id: session.source for session in one.sessions.sessions}
            table = one.map.experiences
            keys = _keys_of(one.map)
            templates = table.array("template")
            new = [
                i for i, key in enumerate(keys)
                if key not in offered and key[0] in own and templates[i] != NO_TEMPLATE
            ][: MOST_OFFERED - len(places)]  # fmt: skip
            if new:
                looks = one.view.templates.array("pixels")[templates[new]]
                for i, view, look in zip(new, template_ids(looks).tolist(), looks, strict=True):
                    if view not in sent:
                        sent.add(view)
                        pixels.append(look)
                    session, number = keys[i]
                    offered.add(keys[i])
                    places.append(
                        (row_of(session), number, max(int(table.array("first_frame")[i]), 0), view,
                         table.array("pose")[i], table.array("cell")[i])
                    )  # fmt: skip
            for ends, measured in _links_of(one.map, keys):
                known = ends[0] in offered and ends[1] in offered
                if ends not in self._links and known and len(links) < MOST_ROWS:
                    (a, source), (b, target) = ends
                    links.append((row_of(a), row_of(b), source, target, *measured))
        n = self.brain.view.geometry.width * self.brain.view.geometry.height
        return Offer(
            tuple(sessions),
            tuple(sources.get(session, "") for session in sessions),
            np.array(pixels, np.uint8).reshape(-1, n),
            np.array(places, PLACE),
            np.array(links, LINK),
        )

    def offer(self) -> list[Receipt]:
        """Offer what is new; return the receipts, of which there are none if nothing is.

        Raises:
            SharedMapError: If the journal refuses it, or cannot be reached. Nothing is lost: what
                was not acknowledged is part of the next offer.
        """
        receipts = []
        while not (offer := self.news()).empty:
            if not self.name:
                self.name = session_name(self.brain.sessions.sessions[0].id)
            message = encode(offer)
            receipts.append(self.journal.offer(self.name, message))
            self.sent_bytes += len(message)
            self.acknowledge(offer)
        return receipts

    def acknowledge(self, offer: Offer) -> None:
        """Note that an offer is on the disk of the journal: it is not offered again."""
        ids = offer.sessions
        self._templates.update(template_ids(offer.pixels).tolist())
        self._places.update((ids[row[0]], row[1]) for row in offer.places.tolist())
        self._links.update(
            ((ids[row[0]], row[2]), (ids[row[1]], row[3])) for row in offer.links.tolist()
        )

    # --- the places of other robots ------------------------------------------------------------

    def take(self) -> int:
        """Take what came since the last call; return the number of places usable now.

        A place is usable once the fold has confirmed its robot. Of a confirmed robot, a place that
        was offered later lies where its links put it, until the next fold.

        Raises:
            SharedMapError: If the journal cannot be reached; the map stays as it is.
        """
        fresh, own = False, _own_sessions(self.brain)
        while entries := self.journal.since(self._cursor):
            for entry in entries:
                offer = decode(entry.message)
                self.records.add(entry.robot, offer)
                if own & {offer.sessions[k] for k in offer.places["session"].tolist()}:
                    self.name = self.name or entry.robot
                if entry.robot == self.name:
                    self.acknowledge(offer)
                else:
                    self.taken_bytes += len(entry.message)
            self._cursor, fresh = entries[-1].number, True
        published = self.journal.published()
        if published is not None and published.digest != self._fold:
            self._fold, fresh = published.digest, True
            self.taken_bytes += len(published.layout)
            self._layout = unpack_layout(published.layout)
            self.confirmed = tuple(json.loads(published.report)["robots"])
            self._poses = {
                (session, number): Pose(*pose.tolist())
                for session, number, _, pose in self._layout.tolist()
            }
        if fresh:
            self._place()
            self._map = None
        return len(self._poses)

    def _place(self) -> None:
        """Put new places of confirmed robots where their links lead from places that lie already.

        In order of the ends of the links, so that the result does not depend on the arrival.
        """
        robots, confirmed = self.records.robots, set(self.confirmed)
        doubtful = self.records.conflicts
        there = self.records.places
        left = [
            ends
            for ends in sorted(self.records.links)
            if any(end not in self._poses for end in ends)
            and all(
                end in there and robots[end[0]] in confirmed and end[0] not in doubtful
                for end in ends
            )
        ]
        while left:
            waiting = []
            for ends in left:
                source, target = ends
                step = _step(self.records.links[ends])
                if source in self._poses and target not in self._poses:
                    self._poses[target] = compose(self._poses[source], step)
                elif target in self._poses and source not in self._poses:
                    back = relative(step, Pose(0.0, 0.0, 0.0))
                    self._poses[source] = compose(self._poses[target], back)
                elif source not in self._poses:
                    waiting.append(ends)
            if len(waiting) == len(left):
                break
            left = waiting

    @property
    def map(self) -> NavigationBrain:
        """The shared map as it is known here: a brain to localise in, plan on and draw.

        Raises:
            SharedMapError: If no place is confirmed yet.
        """
        if self._map is None:
            self._map = self._built()
        return self._map

    def _built(self) -> NavigationBrain:
        records = self.records
        keys = tuple(sorted(self._poses.keys() & records.places.keys()))
        if not keys:
            raise SharedMapError(
                "shared map: no place is confirmed yet; expected a fold of its offers: "
                "neuroslam live DIR"
            )
        links = tuple(
            ends for ends in sorted(records.links)
            if ends[0] in self._poses and ends[1] in self._poses
        )  # fmt: skip
        brain = piece_map(records, Piece(self.name, keys, links), self.config, solved=False)
        poses = np.array([self._poses[key] for key in keys], dtype=np.float64)
        brain.map.experiences.array("pose")[:] = poses
        self._keys = list(keys)
        self._connect(brain)
        return brain

    def _connect(self, brain: NavigationBrain) -> None:
        """Link the places of several robots that the fold found to be one."""
        rows = {key: i for i, key in enumerate(self._keys)}
        first: dict[int, int] = {}
        poses = brain.map.poses
        for session, number, experience, _ in self._layout.tolist():
            i = rows.get((session, number))
            if i is None:
                continue
            j = first.setdefault(experience, i)
            if i != j:
                x, y, turn = relative(Pose(*poses[j].tolist()), Pose(*poses[i].tolist()))
                brain.map.links_table.append(
                    source=j, target=i, distance_m=float(np.hypot(x, y)),
                    heading_rad=float(np.arctan2(y, x)), facing_rad=turn, duration_s=0.0,
                )  # fmt: skip

    def recognise(self, image: np.ndarray) -> Recognised | None:
        """Return the place of the shared map whose view an image matches; ``None``: no such.

        One view is a hint; :meth:`localiser` confirms by a sequence of them.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

        Raises:
            BadFrame: If it is no such image.
            SharedMapError: If no place is confirmed yet.
        """
        brain = self.map
        view = brain.view.usable_view(image)
        if view is None:
            return None
        match = brain.view.search(view, self.config.view.threshold)
        if match.template == NO_TEMPLATE or match.error > self.config.view.threshold:
            return None
        at = int(np.flatnonzero(brain.map.experiences.array("template") == match.template)[0])
        key = self._keys[at]
        pose = Pose(*brain.map.poses[at].tolist())
        return Recognised(key, self.records.robots[key[0]], pose, match.error)

    def localiser(self) -> Localiser:
        """Return a localiser in the shared map as it is now."""
        return Localiser(self.map)

    @property
    def pose(self) -> Pose | None:
        """Pose of this robot on the shared map; ``None`` until its places are confirmed there."""
        map_ = self.brain.map
        if map_.current < 0:
            return None
        at = self._poses.get(_keys_of(map_)[map_.current])
        return None if at is None else compose(at, map_.offset)

    @property
    def placed(self) -> set[Key]:
        """Places that lie on this robot's copy of the shared map."""
        return set(self._poses)

    @property
    def n_offered(self) -> int:
        """Number of this robot's places that were acknowledged."""
        return len(self._places)

    def __repr__(self) -> str:
        """Name the robot and the places that it knows."""
        return f"LiveRobot({self.name!r}, {counted(len(self._poses), 'place')} of the shared map)"


def _own_sessions(brain: NavigationBrain) -> set[int]:
    """Return the sessions of this drive, also those that a kidnapping or a gap ended."""
    if not brain.sessions.sessions:
        return set()
    before = {
        session.id: session.continues
        for one in (brain, *brain.stored)
        for session in one.sessions.sessions
    }
    own, session = set(), brain.sessions.now.id
    while session:
        own.add(session)
        session = before.get(session, 0)
    return own


def _keys_of(map_: ExperienceMap) -> list[Key]:
    table = map_.experiences
    return list(zip(table.array("session").tolist(), table.array("number").tolist(), strict=True))


def _links_of(map_: ExperienceMap, keys: list[Key]) -> list[tuple[tuple[Key, Key], Measured]]:
    """Return the links of a map, and for each place that became part of another one of length 0."""
    links = map_.links
    rows = zip(*(column.tolist() for column in links), strict=True)
    found = [((keys[a], keys[b]), Measured(*rest)) for a, b, *rest in rows]
    table = map_.aliases
    columns = [
        table.array(name).tolist() for name in ("session", "number", "experience", "turn_rad")
    ]
    for session, number, experience, turn in zip(*columns, strict=True):
        if keys[experience] != (session, number):
            ends = keys[experience], (session, number)
            found.append((ends, Measured(0.0, 0.0, turn, 0.0)))
    return found


def _step(link: Measured) -> Pose:
    """Return the pose of a link's target in the frame of its source."""
    x = link.distance_m * np.cos(link.heading_rad)
    return Pose(float(x), float(link.distance_m * np.sin(link.heading_rad)), link.facing_rad)
