"""Experience map: a graph of experiences that odometry extends and relaxation makes consistent."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch

from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, compose, rotate, wrap_angle, wrap_angles
from neuroslam.mapping.actions import choose_action
from neuroslam.mapping.graph import ExperienceGraph
from neuroslam.mapping.incremental import IncrementalSolver
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.mapping.planning import Plan
from neuroslam.mapping.relax import Relaxation
from neuroslam.mapping.tables import closes_loop
from neuroslam.mapping.usage import close_to
from neuroslam.state.population import Action, Correction
from neuroslam.state.renumbering import Renumbering
from neuroslam.types import (
    NO_EXPERIENCE,
    NO_TEMPLATE,
    Motion,
    Pose,
    PoseEstimate,
    Revoked,
    Tracking,
    ViewMatch,
)


class ExperienceMap(ExperienceGraph):
    """Graph of experiences and links that follows a session.

    The robot's pose is the pose of the current experience plus the odometry accumulated since.
    ``forward`` takes one frame: odometry, action, relaxation.

    Args as of :class:`~neuroslam.mapping.graph.ExperienceGraph`, which lists the state.
    """

    __call__: Callable[..., tuple[Action, int]]

    def __init__(
        self,
        config: MapConfig,
        torus: tuple[int, int, int] = (21, 21, 36),
        threshold_cells: float = 2.0,
    ) -> None:
        super().__init__(config, torus, threshold_cells)
        self._relaxation: Relaxation | None = None  # follows from the links, made when needed
        self._solver: IncrementalSolver | None = None  # likewise
        self._solved = 0  # links that it has taken in
        self.register_load_state_dict_pre_hook(_forget_links)

    def forward(
        self,
        motion: Motion,
        view: ViewMatch,
        cells: PoseEstimate,
        frame: int,
        *,
        kidnapped: bool = False,
        tracking: Tracking | None = None,
    ) -> tuple[Action, int]:
        """Advance by one frame; return the action and the experience that the robot is at.

        Args:
            motion: Since the last frame.
            view: Match of the frame's view.
            cells: Pose-cell estimate.
            frame: Number of the frame.
            kidnapped: The robot did not drive to where the view was learnt: no link is made.
            tracking: Where a sequence of views localises the robot; ``None``: the view and the
                pose cells decide.
        """
        self.move(motion)
        action: Action = "none"
        self.state.on_path = int(tracking is not None and tracking.kind in ("at", "link"))
        if tracking is not None:
            action = self._follow_sequence(view, cells, frame, tracking, kidnapped)
        elif view.template != NO_TEMPLATE:
            turned = view.relative_heading_rad * self.torus[2] / TWO_PI
            action, found = choose_action(
                cells,
                turned,
                self.experiences.array("cell"),
                self.experiences.array("template"),
                view.template,
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

    def _follow_sequence(
        self,
        view: ViewMatch,
        cells: PoseEstimate,
        frame: int,
        tracking: Tracking,
        kidnapped: bool,
    ) -> Action:
        """Create the experience of a new view, or go to that where the robot is localised."""
        if tracking.revoked is not None:
            self._undo(tracking.revoked)
        elif tracking.kind == "leave" and self.current != NO_EXPERIENCE:
            here = self.pose  # left near the last experience passed, not where it was seen last
            self.state.current = self._along_links()[2]
            self.set_pose(here)
        if view.is_new:
            self.create(view.template, cells, frame)
            return "create"
        there = tracking.experience
        if tracking.kind not in ("at", "link", "set") or there in (NO_EXPERIENCE, self.current):
            return "none"
        if tracking.kind == "set" or kidnapped:
            self.relocalise(there, view.relative_heading_rad)
            return "set"
        if tracking.kind == "at" and not self._linked(self.current, there):
            self.relocalise(there, view.relative_heading_rad)  # it has passed more than one link
            return "link"
        if tracking.kind == "at":
            self._measure_again(there, view.relative_heading_rad)
        self.link(there, view.relative_heading_rad)
        return "link"

    def _measure_again(self, target: int, relative_heading_rad: float) -> None:
        """Average the link from the current experience with what odometry measured this time.

        A path that is driven again makes no experience, so its links have to improve instead.
        """
        s, gain = self.state, self.config.link_gain
        source, targets = (self.links_table.array(name) for name in ("source", "target"))
        rows = np.flatnonzero((source == s.current) & (targets == target))
        if not len(rows) or not gain:
            return
        link, heading = int(rows[0]), self.experiences.array("pose")[s.current, 2].item()
        length, direction, facing = (
            self.links_table.array(name) for name in ("distance_m", "heading_rad", "facing_rad")
        )
        ahead, left = rotate(s.dx_m, s.dy_m, -heading)
        x = (1.0 - gain) * length[link] * math.cos(direction[link]) + gain * ahead
        y = (1.0 - gain) * length[link] * math.sin(direction[link]) + gain * left
        turned = wrap_angle(s.facing_rad - relative_heading_rad - heading - facing[link])
        length[link], direction[link] = math.hypot(x, y), math.atan2(y, x)
        facing[link] = wrap_angle(facing[link] + gain * turned)
        if self._relaxation is not None:
            measured = length[link], direction[link], facing[link]
            self._relaxation.measure_again(link, *(value.item() for value in measured))
        if self._solver is not None:
            self._solver.measure_again(link, length[link], direction[link], facing[link])
        s.at_rest = 0

    def _undo(self, revoked: Revoked) -> None:
        """Drop the link of a loop closure, and put the robot where odometry alone takes it."""
        source, target = (self.links_table.array(name) for name in ("source", "target"))
        kept = torch.from_numpy((source != revoked.source) | (target != revoked.target))
        table = self.links_table
        table.replace(**{name: table[name][kept] for name in table.columns})
        self._relaxation = None
        s = self.state
        s.current, s.at_rest = revoked.source, 0
        here = compose(Pose(*self.experiences.array("pose")[s.current].tolist()), revoked.offset)
        self.set_pose(here)

    def visit(
        self, place: int, pose: Pose, elapsed_s: float, frame: int, at: Pose | None = None
    ) -> tuple[Action, int]:
        """Follow cells that lead the map: each place cell, or each landmark, is an experience.

        Args:
            place: Id of the experience; the next free id for a new one; -1 if it is not known.
            pose: Pose of the robot on this map.
            elapsed_s: Time since the last frame.
            frame: Number of the frame.
            at: Pose of the experience, if new; ``None``: that of the robot.

        Returns:
            The action, and the experience that the robot is at.
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
        """Set the pose of the robot; its current experience stays the same."""
        s = self.state
        x = y = 0.0
        if s.current != NO_EXPERIENCE:
            x, y, _ = self.experiences.array("pose")[s.current].tolist()
        s.dx_m, s.dy_m, s.facing_rad = pose.x_m - x, pose.y_m - y, wrap_angle(pose.theta_rad)

    def nudge(self, dx_m: float, dy_m: float, turn_rad: float) -> None:
        """Move and turn the robot by a correction of its pose."""
        s = self.state
        s.dx_m += dx_m
        s.dy_m += dy_m
        s.facing_rad = wrap_angle(s.facing_rad + turn_rad)

    def follow(self, correction: Correction) -> None:
        """Move and turn the robot by the correction of a population."""
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
        """Make an experience at the robot's pose, link the last one to it, and go to it.

        Args:
            template: Template of the experience.
            cells: Pose-cell estimate of the experience.
            frame: Number of the frame.
            relative_heading_rad: Heading of the robot minus that at which the view was learnt.

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
        """Close a loop: go to a known experience, and link the last one to it if it is not yet.

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
        """Go to a known experience without a link; reset accumulated odometry and time.

        Raises:
            MapError: If there is no such experience.
        """
        self._check(target)
        self._arrive(target, relative_heading_rad)

    def relax(self, loops: int | None = None) -> float:
        """Reduce the residuals of the links, unless relaxation has converged.

        Args:
            loops: Number of loops of the solver ``relax``; that of the config if not given.

        Returns:
            Largest correction of the last loop, in m or rad; 0 if it had converged before.
        """
        s, c = self.state, self.config
        loops = c.loops if loops is None else loops
        if s.at_rest or not self.links_table.n or not loops:
            s.largest_correction, self._solved = 0.0, self.links_table.n
            return 0.0
        poses = self.experiences.array("pose")
        if c.solver == "incremental":
            solved = poses.copy()
            if self._solver is None:
                report = self._incremental_solver().solve(solved)
            else:
                report = self._solver.update(solved, self._solved)
            s.largest_correction = report.largest
            s.at_rest, self._solved = 1, self.links_table.n
        elif c.solver == "least_squares":
            links = self.links
            solved, _ = solve_pose_graph(
                poses,
                *links[:5],
                sigma_m=c.sigma_m,
                sigma_rad=c.sigma_rad,
                rejectable=closes_loop(*links[:2]) if c.robust else None,
            )
            moved = solved - poses
            moved[:, 2] = wrap_angles(moved[:, 2])
            s.largest_correction = float(np.abs(moved).max())
            s.at_rest = 1  # solved, until the next new link
        else:
            if self._relaxation is None:
                self._relaxation = Relaxation(*self.links[:5])
            solved, s.largest_correction = self._relaxation.run(
                poses, loops, c.correction, c.rest_tolerance
            )
            s.at_rest = int(s.largest_correction <= c.rest_tolerance)
        turned = float(solved[s.current, 2] - poses[s.current, 2])
        poses[:] = solved
        self._turn_offset(wrap_angle(turned))
        return s.largest_correction

    def solve(self) -> None:
        """Solve the whole map, if the solver works on parts of it: at the end of a run."""
        if self.config.solver == "incremental" and self.config.loops:
            self.state.at_rest, self._solver = 0, None
            self.relax()

    def _incremental_solver(self) -> IncrementalSolver:
        """Make the solver for the links that there are, all of them taken in."""
        c, links = self.config, self.links
        self._solver = IncrementalSolver(
            *links[:5],
            sigma_m=c.sigma_m,
            sigma_rad=c.sigma_rad,
            doubted=closes_loop(*links[:2]) if c.robust else None,
        )
        self._solver.weigh(self.experiences.array("pose"))
        self._solved = self.links_table.n
        return self._solver

    def reset_links(self) -> None:
        """Set the links to what the poses say, so that all residuals are 0."""
        links, poses = self.links, self.poses
        moved = poses[links.target] - poses[links.source]
        heading = poses[links.source, 2]
        columns = links._replace(
            distance_m=np.hypot(moved[:, 0], moved[:, 1]),
            heading_rad=wrap_angles(np.arctan2(moved[:, 1], moved[:, 0]) - heading),
            facing_rad=wrap_angles(moved[:, 2]),
        )
        self.links_table.replace(**{k: torch.from_numpy(v) for k, v in columns._asdict().items()})
        self._relaxation = self._solver = None

    def add_goal(self, experience: int, timeout_s: float = math.inf) -> None:
        """Append an experience to visit; drop it when it is reached, or after ``timeout_s``.

        Raises:
            MapError: If there is no such experience, or the time is not positive.
        """
        self._check(experience)
        if not timeout_s > 0.0:
            raise MapError(
                f"ExperienceMap: time-out of a goal is {timeout_s} s; expected more than 0"
            )
        self.goals.append(experience=experience, until_s=self.state.time_s + timeout_s)

    def plans(self) -> Iterator[tuple[int, Plan]]:
        """Yield every goal in order, with the plan to it from the current experience.

        The plan of a goal that cannot be reached has the reason. Such a goal stays in the list,
        for a link made later can lead to it.
        """
        for goal in self.goals["experience"].tolist():
            yield goal, self.plan(goal)

    def next_waypoint(self) -> int | None:
        """Return the next experience on the path to the first goal that can be reached.

        Returns:
            The experience; the goal itself if the robot is there; ``None`` if no goal can be
            reached, see :meth:`plans`.
        """
        path = next((plan.path for _, plan in self.plans() if plan.path), None)
        return None if path is None else path[min(1, len(path) - 1)]

    def _drop_finished_goals(self) -> None:
        if not self.goals.n:
            return
        keep = self.goals["until_s"] > self.state.time_s
        here = (self.goals["experience"] == self.state.current).nonzero()
        if len(here):  # reached, unless a goal before it can be reached and comes first
            at = int(here[0])
            before = self.goals["experience"][:at].tolist()
            keep[at] &= any(self.plan(goal).path for goal in before)
        self.goals.replace(**{name: self.goals[name][keep] for name in self.goals.columns})

    def _add_link(self, source: int, target: int, relative_heading_rad: float) -> None:
        s = self.state
        if self.config.solver == "incremental" and self._solver is None and s.at_rest:
            self._incremental_solver()  # loaded at rest: the new link alone is to be taken in
        heading = self.experiences.array("pose")[source, 2].item()
        measured = {
            "distance_m": math.hypot(s.dx_m, s.dy_m),
            "heading_rad": wrap_angle(math.atan2(s.dy_m, s.dx_m) - heading),
            "facing_rad": wrap_angle(s.facing_rad - relative_heading_rad - heading),
        }
        self.links_table.append(source=source, target=target, duration_s=s.since_s, **measured)
        if self._relaxation is not None:
            self._relaxation.add_link(source, target, **measured)
        if self._solver is not None:
            ends = (self.links_table.array(name) for name in ("source", "target"))
            doubted = self.config.robust and bool(closes_loop(*ends)[-1])
            self._solver.add_link(source, target, *measured.values(), doubted=doubted)

    def _arrive(self, experience: int, relative_heading_rad: float) -> None:
        s = self.state
        if self.forgets:
            self.usage.extend(self.n)
            close = None
            if self.config.consolidate_passes and self.n_links:
                close = close_to(self.pose_table, experience, self.spacing_m)
            self.usage.arrive(experience, self.half_life, close)
        s.current = experience
        s.dx_m = s.dy_m = s.since_s = 0.0
        heading = self.experiences.array("pose")[experience, 2].item()
        s.facing_rad = wrap_angle(heading + relative_heading_rad)

    def renumber(self, change: Renumbering) -> None:
        """Forget experiences; what follows from the links is made again."""
        super().renumber(change)
        self._relaxation = self._solver = None

    def _turn_offset(self, by_rad: float) -> None:
        """Keep the robot's pose relative to its experience when the experience turns."""
        s = self.state
        s.dx_m, s.dy_m = rotate(s.dx_m, s.dy_m, by_rad)
        s.facing_rad = wrap_angle(s.facing_rad + by_rad)


def _forget_links(module: ExperienceMap, *_unused: object) -> None:
    """Drop what follows from the links, as others are loaded."""
    module._relaxation = module._solver = None
