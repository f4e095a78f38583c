"""Experience map: a graph of places that odometry builds and relaxation makes consistent."""

import math

import numpy as np
import torch

from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.mapping.joining import merge_maps
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.mapping.planning import Plan, quickest_path, shortest_path_lengths
from neuroslam.mapping.relax import Relaxation
from neuroslam.mapping.tables import (
    ALIAS_COLUMNS,
    EXPERIENCE_COLUMNS,
    LINK_COLUMNS,
    Links,
    Origins,
    closes_loop,
    origin_key,
)
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.population import Action, Correction
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, NO_TEMPLATE, Motion, Pose, PoseEstimate, ViewMatch


def choose_action(
    cells: PoseEstimate,
    relative_heading_cells: float,
    bound: np.ndarray,
    ids: np.ndarray,
    current: int,
    threshold_cells: float,
    torus: tuple[int, int, int],
) -> tuple[Action, int]:
    """Decide whether a view at a pose is a new place, a known one, or the one we are at.

    Args:
        cells: Pose-cell estimate now.
        relative_heading_cells: Heading now minus heading when the view was learnt, in cells.
        bound: Pose-cell estimates at which the experiences with this view were made, ``(m, 3)``.
        ids: Their ids, ``(m,)``.
        current: Id of the experience we are at.
        threshold_cells: Farther than this (toroidal distance) is another place.
        torus: ``(n_x, n_y, n_theta)``.

    Returns:
        ``("create", -1)``, ``("link", id)`` or ``("none", current)``.

    Example:
        >>> near = np.array([[5.0, 5.0, 0.5]])
        >>> choose_action(PoseEstimate(5, 6, 35.5), 0.0, near, np.array([3]), 7, 2.0, (21, 21, 36))
        ('link', 3)
    """
    if len(ids) == 0:
        return "create", NO_EXPERIENCE
    n = np.asarray(torus, dtype=np.float64)
    now = np.array([cells.x, cells.y, cells.theta - relative_heading_cells])
    apart = np.abs(bound - now) % n
    apart = np.minimum(apart, n - apart)
    squares = (apart * apart).sum(axis=1)
    nearest = int(squares.argmin())
    if math.sqrt(squares[nearest]) > threshold_cells:
        return "create", NO_EXPERIENCE
    found = int(ids[nearest])
    return ("none", current) if found == current else ("link", found)


class ExperienceMap(Mergeable):
    """Graph of experiences (places with a view and a pose-cell state) and the links between them.

    The robot's pose is the pose of the current experience and the odometry accumulated since.
    ``forward`` takes one frame: odometry, action, relaxation. State: the tables ``experiences``,
    ``links_table``, ``goals``, ``aliases`` (experiences that a merge made part of others) and the
    numbers in ``state``.

    Args:
        config: Solver, correction, loops.
        torus: ``(n_x, n_y, n_theta)`` of the pose cells that the experiences are bound to.
        threshold_cells: Distance in cells beyond which a known view is a new place.
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
        self.state = Scalars(
            current=NO_EXPERIENCE,
            dx_m=0.0,  # map frame, since the current experience
            dy_m=0.0,
            facing_rad=math.radians(config.initial_heading_deg),
            since_s=0.0,
            time_s=0.0,
            largest_correction=0.0,
            at_rest=1,
            session=0,
            made=0,  # experiences, in this session
        )
        self._relaxation: Relaxation | None = None  # follows from the links, made when needed

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
        """Poses of all experiences, ``(n, 3)``; a view of the state, to read only."""
        return self.experiences["pose"].numpy(force=True)

    @property
    def poses(self) -> np.ndarray:
        """Poses of all experiences, ``(n, 3)``: x, y in metres, heading in radians; a copy."""
        return self.experiences["pose"].numpy(force=True).copy()

    @property
    def links(self) -> Links:
        """All links, as arrays; a copy."""
        return Links(*(self.links_table[c].numpy(force=True).copy() for c in Links._fields))

    @property
    def largest_correction(self) -> float:
        """Largest correction (m or rad) of the last relaxation loop; 0 for a map at rest."""
        return self.state.largest_correction

    @property
    def pose(self) -> Pose:
        """Pose of the robot in the map now."""
        s = self.state
        if s.current == NO_EXPERIENCE:
            return Pose(s.dx_m, s.dy_m, s.facing_rad)
        x, y, _ = self.experiences["pose"][s.current].tolist()
        return Pose(x + s.dx_m, y + s.dy_m, s.facing_rad)

    @property
    def offset(self) -> Pose:
        """Pose of the robot relative to the current experience (to the origin before the first)."""
        s = self.state
        heading = 0.0
        if s.current != NO_EXPERIENCE:
            heading = self.experiences["pose"][s.current, 2].item()
        c, si = math.cos(heading), math.sin(heading)
        return Pose(
            c * s.dx_m + si * s.dy_m,
            -si * s.dx_m + c * s.dy_m,
            wrap_angle(s.facing_rad - heading),
        )

    def forward(
        self,
        motion: Motion,
        view: ViewMatch,
        cells: PoseEstimate,
        frame: int,
        *,
        kidnapped: bool = False,
    ) -> tuple[Action, int]:
        """Take in one frame; returns what was done and the experience the robot is at.

        Args:
            motion: Since the last frame.
            view: What was recognised.
            cells: Pose-cell estimate.
            frame: Its number.
            kidnapped: The robot did not drive to where it recognises a view: no link is made.
        """
        self.move(motion)
        action: Action = "none"
        if view.template != NO_TEMPLATE:
            turned = view.relative_heading_rad * self.torus[2] / TWO_PI
            templates = self.experiences["template"].numpy(force=True)
            ids = np.flatnonzero(templates == view.template)
            action, found = choose_action(
                cells,
                turned,
                self.experiences["cell"].numpy(force=True)[ids],
                ids,
                self.state.current,
                self.threshold_cells,
                self.torus,
            )
            if action == "create":
                corrected = cells._replace(theta=(cells.theta - turned) % self.torus[2])
                self.create(view.template, corrected, frame, view.relative_heading_rad)
            elif action == "link" and kidnapped:
                action = "set"
                self.relocalise(found, view.relative_heading_rad)
            elif action == "link":
                self.link(found, view.relative_heading_rad)
        self.relax()
        self._drop_finished_goals()
        return action, self.state.current

    def visit(
        self, place: int, pose: Pose, elapsed_s: float, frame: int, at: Pose | None = None
    ) -> tuple[Action, int]:
        """Take in where cells say that the robot is; each place cell, or landmark, is a place.

        Args:
            place: Number of it; that of the next experience for a new one; -1 where the robot
                does not know its place.
            pose: Of the robot, on this map.
            elapsed_s: Time since the last frame.
            frame: Number of the frame.
            at: Where the place is; ``None``: where the robot is.

        Returns:
            What was done, and the experience the robot is at.
        """
        action: Action = "none"
        self.state.since_s += elapsed_s
        self.state.time_s += elapsed_s
        self.set_pose(pose)
        if place not in (NO_EXPERIENCE, self.state.current):
            action = "create" if place == self.n else "link"
            self.set_pose(at or pose)
            if action == "create":
                self.create(NO_TEMPLATE, PoseEstimate(0.0, 0.0, 0.0), frame)
            else:
                self.link(place)
            self.set_pose(pose)
        self._drop_finished_goals()
        return action, self.state.current

    def set_pose(self, pose: Pose) -> None:
        """Put the robot somewhere; it stays at the experience it is at."""
        s = self.state
        x = y = 0.0
        if s.current != NO_EXPERIENCE:
            x, y, _ = self.experiences["pose"][s.current].tolist()
        s.dx_m, s.dy_m, s.facing_rad = pose.x_m - x, pose.y_m - y, wrap_angle(pose.theta_rad)

    def nudge(self, dx_m: float, dy_m: float, turn_rad: float) -> None:
        """Move and turn the robot a little, as something else has corrected its pose."""
        s = self.state
        s.dx_m += dx_m
        s.dy_m += dy_m
        s.facing_rad = wrap_angle(s.facing_rad + turn_rad)

    def follow(self, correction: Correction) -> None:
        """Move and turn the robot by what a population has corrected."""
        if correction.moves:
            dx, dy = correction.displacement(self.state.facing_rad)
            self.nudge(dx, dy, correction.turn_rad)

    def move(self, motion: Motion) -> None:
        """Accumulate odometry: turn, then move along the new heading."""
        s = self.state
        s.facing_rad = wrap_angle(s.facing_rad + motion.w_rad_s * motion.dt_s)
        step = motion.v_m_s * motion.dt_s
        s.dx_m += step * math.cos(s.facing_rad)
        s.dy_m += step * math.sin(s.facing_rad)
        s.since_s += motion.dt_s
        s.time_s += motion.dt_s

    def create(
        self, template: int, cells: PoseEstimate, frame: int, relative_heading_rad: float = 0.0
    ) -> int:
        """Make an experience where the robot is, link it from the last one, and go there.

        Args:
            template: View of the new place.
            cells: Pose-cell estimate it is bound to.
            frame: Number of the frame that made it.
            relative_heading_rad: Heading of the robot minus heading the view was learnt with.

        Returns:
            Id of the new experience.
        """
        s = self.state
        here, previous = self.pose, s.current
        facing = wrap_angle(here.theta_rad - relative_heading_rad)
        new = self.experiences.append(
            pose=torch.tensor([here.x_m, here.y_m, facing], dtype=torch.float64),
            cell=torch.tensor([cells.x, cells.y, cells.theta], dtype=torch.float64),
            template=template,
            first_frame=frame,
            session=s.session,
            number=s.made,
        )
        s.made += 1
        if previous != NO_EXPERIENCE:
            self._add_link(previous, new, relative_heading_rad)
        self._arrive(new, relative_heading_rad)
        return new

    def link(self, target: int, relative_heading_rad: float = 0.0) -> None:
        """Close a loop: link the last experience to a known one, unless they are linked; go there.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(target)
        source = self.state.current
        if source == NO_EXPERIENCE:
            self.relocalise(target, relative_heading_rad)
            return
        if source != target and not self._linked(source, target):
            self._add_link(source, target, relative_heading_rad)
            self.state.at_rest = 0
        self._arrive(target, relative_heading_rad)

    def relocalise(self, target: int, relative_heading_rad: float = 0.0) -> None:
        """Go to a known experience without a link; accumulated odometry and time start anew.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(target)
        self._arrive(target, relative_heading_rad)

    def relax(self, loops: int | None = None) -> float:
        """Bring the links to agree, while the map is not at rest.

        Args:
            loops: Loops of ``relax``; the config's number if not given.

        Returns:
            Largest correction of the last loop, in m or rad; 0 for a map at rest.
        """
        s, c = self.state, self.config
        loops = c.loops if loops is None else loops
        if s.at_rest or not self.links_table.n or not loops:
            s.largest_correction = 0.0
            return 0.0
        poses = self.experiences["pose"]
        if c.solver == "least_squares":
            links = self.links
            solved, _ = solve_pose_graph(
                poses.numpy(),
                *links[:5],
                sigma_m=c.sigma_m,
                sigma_rad=c.sigma_rad,
                doubtful=closes_loop(*links[:2]) if c.robust else None,
            )
            moved = solved - poses.numpy()
            moved[:, 2] = wrap_angles(moved[:, 2])
            s.largest_correction = float(np.abs(moved).max())
            s.at_rest = 1  # it is solved; the next new link wakes it
        else:
            if self._relaxation is None:
                links = self.links
                self._relaxation = Relaxation(*links[:5], n=self.n)
            solved, s.largest_correction = self._relaxation.run(
                poses.numpy(), loops, c.correction, c.rest_tolerance
            )
            s.at_rest = int(s.largest_correction <= c.rest_tolerance)
        turned = solved[s.current, 2].item() - poses[s.current, 2].item()
        poses.copy_(torch.from_numpy(solved))
        self._turn_offset(wrap_angle(turned))
        return s.largest_correction

    def measure_links(self) -> None:
        """Make the links say what the poses do."""
        links, poses = self.links, self.poses
        way = poses[links.target] - poses[links.source]
        heading = poses[links.source, 2]
        columns = links._replace(
            distance_m=np.hypot(way[:, 0], way[:, 1]),
            heading_rad=wrap_angles(np.arctan2(way[:, 1], way[:, 0]) - heading),
            facing_rad=wrap_angles(way[:, 2]),
        )
        self.links_table.replace(**{k: torch.from_numpy(v) for k, v in columns._asdict().items()})
        self._relaxation = None

    def neighbours(self, experience: int) -> list[int]:
        """Return the experiences one link away, in either direction, sorted.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(experience)
        source, target = (self.links_table[c].numpy(force=True) for c in ("source", "target"))
        near = np.concatenate([target[source == experience], source[target == experience]])
        return np.unique(near).tolist()

    def distance_and_bearing(self, experience: int) -> tuple[float, float]:
        """Return how far an experience is (m), and its direction relative to the robot's (rad).

        Raises:
            MapError: If there is no such experience.
        """
        self._check(experience)
        x, y, _ = self.experiences["pose"][experience].tolist()
        here = self.pose
        dx, dy = x - here.x_m, y - here.y_m
        return math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - here.theta_rad)

    def path_lengths_m(self, start: int) -> np.ndarray:
        """Return the length of the shortest way over links to every experience, in m, ``(n,)``."""
        return shortest_path_lengths(self.links, self.n, start)

    def plan(self, goal: int, start: int | None = None) -> Plan:
        """Find the quickest way to an experience by the time its links took, in both directions.

        Args:
            goal: Id to reach.
            start: Id to start from; the current one if not given.

        Returns:
            The way, or one that says why there is none.
        """
        start = self.state.current if start is None else start
        return quickest_path(self.links, self.n, start, goal)

    def add_goal(self, experience: int, timeout_s: float = math.inf) -> None:
        """Append a place to visit; it is dropped when reached, or ``timeout_s`` from now.

        Raises:
            MapError: If there is no such experience, or the time is not positive.
        """
        self._check(experience)
        if not timeout_s > 0.0:
            raise MapError(f"ExperienceMap: time-out of a goal is {timeout_s} s, must be above 0")
        self.goals.append(experience=experience, until_s=self.state.time_s + timeout_s)

    def next_waypoint(self) -> int | None:
        """Return the next experience on the way to the first goal; ``None`` if there is no way."""
        if not self.goals.n:
            return None
        way = self.plan(int(self.goals["experience"][0])).path
        return way[min(1, len(way) - 1)] if way else None

    @property
    def origin(self) -> tuple[int, int]:
        """Session that made the current experience, and its number there; -1 before the first."""
        current = self.state.current
        if current == NO_EXPERIENCE:
            return self.state.session, -1
        table = self.experiences
        return table["session"][current].item(), table["number"][current].item()

    @property
    def residuals_m(self) -> np.ndarray:
        """How far each link's target lies from where the link has it, in m, ``(links,)``."""
        links, poses = self.links, self.poses
        direction = poses[links.source, 2] + links.heading_rad
        dx, dy = (poses[links.target, :2] - poses[links.source, :2]).T
        return np.hypot(
            dx - links.distance_m * np.cos(direction), dy - links.distance_m * np.sin(direction)
        )

    def origins(self) -> Origins:
        """Return where every experience comes from, with those that merges made part of others."""
        own, other = (
            {name: table[name].numpy(force=True) for name in table.columns}
            for table in (self.experiences, self.aliases)
        )
        own |= {"experience": np.arange(self.n), "turn_rad": np.zeros(self.n)}
        apart = ~np.isin(origin_key(own), origin_key(other))  # an alias says more
        columns = (np.concatenate([own[name][apart], other[name]]) for name in Origins._fields)
        return Origins(*columns)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Place the partial experiences in the loaded map and reroute their links."""
        return merge_maps(loaded, partial, join)

    def _drop_finished_goals(self) -> None:
        if not self.goals.n:
            return
        keep = self.goals["until_s"] > self.state.time_s
        keep[0] &= self.goals["experience"][0] != self.state.current
        self.goals.replace(**{name: self.goals[name][keep] for name in self.goals.columns})

    def _linked(self, a: int, b: int) -> bool:
        source, target = (self.links_table[c].numpy(force=True) for c in ("source", "target"))
        return bool((((source == a) & (target == b)) | ((source == b) & (target == a))).any())

    def _add_link(self, source: int, target: int, relative_heading_rad: float) -> None:
        s = self.state
        heading = self.experiences["pose"][source, 2].item()
        self.links_table.append(
            source=source,
            target=target,
            distance_m=math.hypot(s.dx_m, s.dy_m),
            heading_rad=wrap_angle(math.atan2(s.dy_m, s.dx_m) - heading),
            facing_rad=wrap_angle(s.facing_rad - relative_heading_rad - heading),
            duration_s=s.since_s,
        )
        self._relaxation = None

    def _arrive(self, experience: int, relative_heading_rad: float) -> None:
        s = self.state
        s.current = experience
        s.dx_m = s.dy_m = s.since_s = 0.0
        heading = self.experiences["pose"][experience, 2].item()
        s.facing_rad = wrap_angle(heading + relative_heading_rad)

    def _turn_offset(self, by_rad: float) -> None:
        """Keep the robot where it is relative to its experience when that turns."""
        s = self.state
        c, si = math.cos(by_rad), math.sin(by_rad)
        s.dx_m, s.dy_m = c * s.dx_m - si * s.dy_m, si * s.dx_m + c * s.dy_m
        s.facing_rad = wrap_angle(s.facing_rad + by_rad)

    def _check(self, experience: int) -> None:
        if not 0 <= experience < self.experiences.n:
            raise MapError(
                f"ExperienceMap: no experience {experience}, there are {self.experiences.n}"
            )

    def _apply(self, fn: object, recurse: bool = True) -> "ExperienceMap":
        return self  # a graph of float64 numbers for sparse solvers: it stays on the CPU
