"""Graph of experiences and links: its state, and queries that leave it unchanged."""

import math
from typing import Self

import numpy as np
import torch

from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.geometry import rotate, wrap_angle
from neuroslam.mapping.incremental import link_weights
from neuroslam.mapping.joining import merge_maps
from neuroslam.mapping.planning import Plan, quickest_path, shortest_path_lengths
from neuroslam.mapping.tables import (
    ALIAS_COLUMNS,
    EXPERIENCE_COLUMNS,
    LINK_COLUMNS,
    Links,
    Origins,
    origin_key,
)
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, Pose


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
        )


class ExperienceGraph(Mergeable):
    """Experiences, the links between them, and the pose of the robot; the base of the map.

    State: the tables ``experiences``, ``links_table``, ``goals`` and ``aliases`` (experiences that
    a merge made part of others), and the numbers in ``state``.

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
        return Pose(x + s.dx_m, y + s.dy_m, s.facing_rad)

    @property
    def offset(self) -> Pose:
        """Pose of the robot relative to the current experience (to the origin before the first)."""
        s = self.state
        heading = 0.0
        if s.current != NO_EXPERIENCE:
            heading = self.experiences.array("pose")[s.current, 2].item()
        dx, dy = rotate(s.dx_m, s.dy_m, -heading)
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

    def plan(self, goal: int, start: int | None = None) -> Plan:
        """Find the quickest path to an experience by link durations; links work in both directions.

        Args:
            goal: Id to reach.
            start: Id to start from; the current one if not given.

        Returns:
            The path, or an empty one with the reason.
        """
        start = self.state.current if start is None else start
        return quickest_path(self.links, self.n, start, goal)

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
        """Return the origin of every experience, also of those that a merge made part of others."""
        own, other = (
            {name: table[name].numpy(force=True) for name in table.columns}
            for table in (self.experiences, self.aliases)
        )
        own |= {"experience": np.arange(self.n), "turn_rad": np.zeros(self.n)}
        kept = ~np.isin(origin_key(own), origin_key(other))  # an alias replaces the own row
        columns = (np.concatenate([own[name][kept], other[name]]) for name in Origins._fields)
        return Origins(*columns)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Place the partial experiences in the loaded map and reroute their links."""
        return merge_maps(loaded, partial, join)

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
