"""Graph of experiences and links: its state, and queries that leave it unchanged."""

import math
from collections.abc import Callable
from typing import Self

import numpy as np
import torch

from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.geometry import compose_poses, rotate, wrap_angle
from neuroslam.mapping.following import along_links
from neuroslam.mapping.forgetting import contract_links, least_used
from neuroslam.mapping.incremental import link_weights
from neuroslam.mapping.joining import merge_maps
from neuroslam.mapping.planning import Plan, quickest_path, shortest_path_lengths
from neuroslam.mapping.sequence import within_links
from neuroslam.mapping.tables import (
    ALIAS_COLUMNS,
    EXPERIENCE_COLUMNS,
    LINK_COLUMNS,
    Links,
    Origins,
    origin_key,
)
from neuroslam.mapping.usage import HALF_LIFE, LONG, Forgotten, Usage, close_to
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, Pose

NEAR_LINKS = 3
"""Links within which an experience is beside another: two strands become one from their ends."""

MOST_FORGOTTEN = 65_536
"""Forgotten experiences whose poses are kept for the trajectory: the latest, 4 MB of them."""


class MapState(Scalars):
    """Where the robot is on the map, and whether relaxation has converged.

    Attributes:
        current: Experience that the robot is at, -1 before the first.
        dx_m: Displacement since then along x of the map; from the origin before the first.
        dy_m: Along y.
        facing_rad: Heading of the robot.
        since_s: Time since the robot arrived at the current experience.
        time_s: Time since the session began.
        largest_correction: Of the last relaxation loop, m or rad; 0 for a map at rest.
        at_rest: 1 if relaxation has converged, else 0.
        session: Id of the session.
        made: Number of experiences that this session has made.
        on_path: 1 while the robot follows the links, as its views show; 0: odometry alone places
            it.
    """

    current: int
    dx_m: float
    dy_m: float
    facing_rad: float
    since_s: float
    time_s: float
    largest_correction: float
    at_rest: int
    session: int
    made: int
    on_path: int

    def __init__(self, initial_heading_deg: float) -> None:
        super().__init__(
            current=NO_EXPERIENCE,
            dx_m=0.0,
            dy_m=0.0,
            facing_rad=math.radians(initial_heading_deg),
            since_s=0.0,
            time_s=0.0,
            largest_correction=0.0,
            at_rest=1,
            session=0,
            made=0,
            on_path=0,
        )


class ExperienceGraph(Mergeable):
    """Experiences, the links between them, and the pose of the robot; the base of the map.

    State: the tables ``experiences``, ``links_table``, ``goals`` and ``aliases`` (experiences that
    a merge made part of others), and the numbers in ``state``; in a map that forgets also ``usage``
    and ``forgotten`` (experiences that are part of others since then).

    Args:
        config: Solver, correction, loops.
        torus: ``(n_x, n_y, n_theta)`` of the pose cells.
        threshold_cells: Distance in cells beyond which a matched view makes a new experience.
    """

    def __init__(
        self,
        config: MapConfig,
        torus: tuple[int, int, int] = (21, 21, 36),
        threshold_cells: float = 2.0,
    ) -> None:
        super().__init__()
        self.config = config
        self.torus = torus
        self.threshold_cells = threshold_cells
        self.experiences = GrowingTable(EXPERIENCE_COLUMNS)
        self.links_table = GrowingTable(LINK_COLUMNS)
        self.goals = GrowingTable({"experience": ((), torch.int64), "until_s": ((), torch.float64)})
        self.aliases = GrowingTable(ALIAS_COLUMNS)
        self.usage, self.forgotten = Usage(), Forgotten()
        self.state = MapState(config.initial_heading_deg)

    @property
    def n(self) -> int:
        """Number of experiences."""
        return self.experiences.n

    @property
    def n_links(self) -> int:
        """Number of links."""
        return self.links_table.n

    @property
    def current(self) -> int:
        """Id of the experience the robot is at, -1 before the first."""
        return self.state.current

    @property
    def pose_table(self) -> np.ndarray:
        """Poses of all experiences, ``(n, 3)``; a read-only view of the state."""
        return self.experiences.array("pose")

    @property
    def poses(self) -> np.ndarray:
        """Poses of all experiences, ``(n, 3)``: x, y in metres, heading in radians; a copy."""
        return self.experiences.array("pose").copy()

    @property
    def links(self) -> Links:
        """All links, as arrays; a copy."""
        return Links(*(self.links_table.array(c).copy() for c in Links._fields))

    @property
    def largest_correction(self) -> float:
        """Largest correction (m or rad) of the last relaxation loop; 0 if it has converged."""
        return self.state.largest_correction

    @property
    def pose(self) -> Pose:
        """Pose of the robot on the map."""
        s = self.state
        if s.current == NO_EXPERIENCE:
            return Pose(s.dx_m, s.dy_m, s.facing_rad)
        x, y, _ = self.experiences.array("pose")[s.current].tolist()
        dx, dy = self._displacement()
        return Pose(x + dx, y + dy, s.facing_rad)

    @property
    def offset(self) -> Pose:
        """Pose of the robot relative to the current experience (to the origin before the first)."""
        s = self.state
        heading = 0.0
        if s.current != NO_EXPERIENCE:
            heading = self.experiences.array("pose")[s.current, 2].item()
        dx, dy = rotate(*self._displacement(), -heading)
        return Pose(dx, dy, wrap_angle(s.facing_rad - heading))

    def neighbours(self, experience: int) -> list[int]:
        """Return the experiences linked with this one in either direction, sorted.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(experience)
        source, target = (self.links_table.array(c) for c in ("source", "target"))
        near = np.concatenate([target[source == experience], source[target == experience]])
        return np.unique(near).tolist()

    def distance_and_bearing(self, experience: int) -> tuple[float, float]:
        """Return distance (m) and bearing (rad, relative to the heading) of an experience.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(experience)
        x, y, _ = self.experiences.array("pose")[experience].tolist()
        here = self.pose
        dx, dy = x - here.x_m, y - here.y_m
        return math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - here.theta_rad)

    def path_lengths_m(self, start: int) -> np.ndarray:
        """Return the shortest-path length from ``start`` to every experience, metres, ``(n,)``."""
        return shortest_path_lengths(self.links, self.n, start)

    def plan(self, goal: int, start: int | None = None, forward: bool = False) -> Plan:
        """Find the quickest path to an experience by link durations.

        Args:
            goal: Id to reach.
            start: Id to start from; the current one if not given.
            forward: Follow links only in the direction in which they were driven.

        Returns:
            The path, or an empty one with the reason.
        """
        start = self.state.current if start is None else start
        return quickest_path(self.links, self.n, start, goal, forward)

    @property
    def origin(self) -> tuple[int, int]:
        """Session that made the current experience and its number there; -1 before the first."""
        current = self.state.current
        if current == NO_EXPERIENCE:
            return self.state.session, -1
        table = self.experiences
        return int(table["session"][current]), int(table["number"][current])

    @property
    def residuals_m(self) -> np.ndarray:
        """Distance of each link's target from where the link puts it, metres, ``(links,)``."""
        links, poses = self.links, self.poses
        direction = poses[links.source, 2] + links.heading_rad
        dx, dy = (poses[links.target, :2] - poses[links.source, :2]).T
        return np.hypot(
            dx - links.distance_m * np.cos(direction), dy - links.distance_m * np.sin(direction)
        )

    @property
    def link_weights(self) -> np.ndarray:
        """Weight of every link at the present poses, ``(links,)``: 1, less if it contradicts.

        That of the robust incremental solver, whichever solver the map has; see
        :func:`~neuroslam.mapping.incremental.link_weights`.
        """
        return link_weights(self.pose_table, self.links, self.config.sigma_m, self.config.sigma_rad)

    def origins(self) -> Origins:
        """Return the origin of every experience, also of those that are part of others now."""
        own, other, gone = (
            {name: table[name].numpy(force=True) for name in table.columns}
            for table in (self.experiences, self.aliases, self.forgotten)
        )
        own |= {"experience": np.arange(self.n), "turn_rad": np.zeros(self.n)}
        gone |= dict(zip(("ahead_m", "left_m", "turn_rad"), gone.pop("pose").T, strict=True))
        for rows, n in ((own, self.n), (other, self.aliases.n)):
            rows |= {"ahead_m": np.zeros(n), "left_m": np.zeros(n)}
        kept = ~np.isin(origin_key(own), origin_key(other))  # an alias replaces the own row
        columns = (
            np.concatenate([own[name][kept], other[name], gone[name]]) for name in Origins._fields
        )
        return Origins(*columns)

    @property
    def forgets(self) -> bool:
        """Whether experiences are forgotten, so that their use is counted."""
        return bool(self.config.max_experiences or self.config.consolidate_passes)

    @property
    def half_life(self) -> float:
        """Arrivals after which a visit counts half."""
        return float(HALF_LIFE * (self.config.max_experiences or LONG))

    @property
    def spacing_m(self) -> float:
        """Mean length of the links."""
        return float(self.links_table.array("distance_m").mean())

    def to_forget(self, protected: list[int]) -> np.ndarray:
        """Choose the experiences beyond the cap and some more, so that it is not done every time.

        Args:
            protected: Ids that are kept in any case, beside those visited lately; -1: none.

        Returns:
            The experience that each is part of from now on, itself if it is kept, ``(n,)``.
        """
        most = self.config.max_experiences
        keep = self._kept_anyway(protected)
        keep |= self.usage.array("at") > self.usage.arrivals - min(64, most // 4)
        count = self.n - most + most // 20
        use = self.usage.log_use(self.half_life)
        return least_used(use, self.links, self.pose_table, keep, count)

    def to_consolidate(
        self, protected: list[int], alike: Callable[[int, int], bool]
    ) -> np.ndarray | None:
        """Choose the experiences that the robot does not arrive at any more.

        Each becomes part of the nearest one at most :data:`NEAR_LINKS` links away that the robot
        does arrive at, if it is close and has a similar heading.

        Args:
            protected: Ids that are kept in any case; -1: none.
            alike: Whether the views of two experiences show the same place.

        Returns:
            The experience that each is part of from now on, ``(n,)``; ``None``: there are too few
            to do it now.
        """
        missed = self.usage.array("missed")
        due = missed >= self.config.consolidate_passes
        due &= ~self._kept_anyway(protected)[: len(due)]
        if due.sum() < max(4, self.n // 64):
            return None
        source, target = (self.links_table.array(name) for name in ("source", "target"))
        ends, others = np.concatenate([source, target]), np.concatenate([target, source])
        into, poses = np.arange(self.n), self.pose_table
        left, before = np.flatnonzero(due).tolist(), []
        while left and left != before:  # one that has gone brings the next nearer to the rest
            before, left = left, []
            for k in before:
                near = close_to(poses, k, self.spacing_m) & ~due
                near &= within_links(k, 0, NEAR_LINKS, into[ends], into[others], self.n)
                found = np.flatnonzero(near)
                apart = poses[found, :2] - poses[k, :2]
                order = np.argsort((apart * apart).sum(1), kind="stable")
                other = next((j for j in found[order].tolist() if alike(k, j)), None)
                if other is None:
                    left.append(k)
                else:
                    into[k] = other
        missed[left] = 0  # they show what no other does: they are looked at again later
        return into

    def _kept_anyway(self, protected: list[int]) -> np.ndarray:
        """Return which experiences cannot be forgotten now, ``bool``, ``(n,)``."""
        self.usage.extend(self.n)
        keep = np.zeros(self.n, dtype=bool)
        keep[[k for k in protected if k >= 0]] = True
        keep[[0, self.state.current, *self.goals["experience"].tolist()]] = True
        return keep

    def renumber(self, change: Renumbering) -> None:
        """Forget experiences: their links lead to the ones that they are part of from now on."""
        ids, kept = change.experiences, change.kept_experiences
        root = kept[ids]
        links = contract_links(self.links, self.pose_table, root)
        links = links._replace(source=ids[links.source], target=ids[links.target])
        self._note_forgotten(change)
        rows = {
            name: change.rows_of_experiences(self.experiences[name])
            for name in self.experiences.columns
        }
        views = change.views[rows["template"].numpy()]
        rows["template"] = torch.from_numpy(views)
        self.experiences.replace(**rows)
        self.links_table.replace(**{k: torch.from_numpy(v) for k, v in links._asdict().items()})
        if self.usage.n:
            self.usage.replace(
                **{c: change.rows_of_experiences(self.usage[c]) for c in self.usage.columns}
            )
        self.goals["experience"][:] = torch.from_numpy(ids[self.goals["experience"].numpy()])
        self.state.current = change.experience(self.state.current)
        self.state.at_rest = 0

    def _note_forgotten(self, change: Renumbering) -> None:
        """Append the experiences that are forgotten, and follow those that were before."""
        ids, own, other, table = change.experiences, self.experiences, self.aliases, self.forgotten
        gone = np.flatnonzero(change.kept_experiences[ids] != np.arange(self.n))
        into = other.array("experience")
        aliased = np.isin(into, gone)
        keys = [
            origin_key({name: rows.array(name) for name in ("session", "number")})
            for rows in (own, other)
        ]
        plain = gone[~np.isin(keys[0][gone], keys[1])]  # an alias of itself has a turn
        turned = np.zeros((int(aliased.sum()), 3))
        turned[:, 2] = other.array("turn_rad")[aliased]
        at = np.concatenate([table.array("experience"), into[aliased], plain])
        pose = np.concatenate([table.array("pose"), turned, np.zeros((len(plain), 3))])
        columns = {
            name: np.concatenate(
                [table.array(name), other.array(name)[aliased], own.array(name)[plain]]
            )
            for name in ("session", "number", "first_frame")
        }
        columns |= {"experience": ids[at], "pose": compose_poses(change.relative[at], pose)}
        most = max(MOST_FORGOTTEN, 16 * self.config.max_experiences)
        table.replace(**{name: torch.from_numpy(rows[-most:]) for name, rows in columns.items()})
        stay = {name: torch.from_numpy(other.array(name)[~aliased]) for name in other.columns}
        stay["experience"] = torch.from_numpy(ids[into[~aliased]])
        other.replace(**stay)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Place the partial experiences in the loaded map and reroute their links."""
        return merge_maps(loaded, partial, join)

    def _displacement(self) -> tuple[float, float]:
        """Return the displacement of the robot from the current experience, along the map."""
        s = self.state
        if not s.on_path or s.current == NO_EXPERIENCE:
            return s.dx_m, s.dy_m
        return self._along_links()[:2]

    def _along_links(self) -> tuple[float, float, int]:
        """Return the displacement of the robot if it followed the links, and where it passed."""
        s = self.state
        source, target = (self.links_table.array(name) for name in ("source", "target"))
        return along_links(s.current, s.dx_m, s.dy_m, self.pose_table, source, target)

    def _linked(self, a: int, b: int) -> bool:
        source, target = (self.links_table.array(c) for c in ("source", "target"))
        return bool((((source == a) & (target == b)) | ((source == b) & (target == a))).any())

    def _check(self, experience: int) -> None:
        if not 0 <= experience < self.experiences.n:
            raise MapError(
                f"ExperienceMap: no experience {experience}, there are {self.experiences.n}"
            )

    def _apply(self, fn: object, recurse: bool = True) -> Self:
        return self  # a graph of float64 numbers for sparse solvers stays on the CPU
