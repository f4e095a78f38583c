"""A robot's own loop: pictures and odometry go in one by one, a pose and events come out."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, Self

import numpy as np
import torch

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.geometry import ORIGIN, relative
from neuroslam.mapping.planning import Plan, leads_to, on_loops, quickest_path
from neuroslam.runs.following import Following, PathFollower
from neuroslam.sensors.frames import check_image
from neuroslam.types import NO_EXPERIENCE, Frame, Pose, StepResult, Velocity

EventKind = Literal["loop_closed", "relocalised", "kidnapped", "joined", "goal_reached"]
"""A link to an experience made earlier; a lost robot found; a robot moved by hand; a stored map
recognised, from which frame on poses are in that map; a goal passed."""

Order = Literal["rgb", "bgr", "grey"]
"""Order of the channels of a picture; OpenCV's is ``bgr``."""

_EARLIER = 20  # experiences since the one that closes a loop
_KNOWN_LINKS = 20.0  # links of odometry alone after which the confidence is 1 / e
_LONG_LINK = (
    4.0  # links as long as that many usual ones are followed only if there is no other path
)
_TURN_LINKS = 6.0  # links that facing to the left or right counts as
_TIMES = 1000  # steps in the figures of time


class Event(NamedTuple):
    """Something that a robot should know.

    Attributes:
        kind: What happened.
        frame: Number of the frame.
        time_s: Its time.
        experience: Where the robot is now.
    """

    kind: EventKind
    frame: int
    time_s: float
    experience: int


class Located(NamedTuple):
    """Where the robot is.

    Attributes:
        pose: On the map, m and rad.
        confidence: In [0, 1]: 0 if lost, 1 where a view was just recognised or the map began; falls
            with the path that odometry alone was followed, to 1/e after 20 links.
        result: All figures of the step.
    """

    pose: Pose
    confidence: float
    result: StepResult


class Timing(NamedTuple):
    """Times of the last 1000 steps in milliseconds.

    Attributes:
        steps: Number of steps.
        median_ms: Half of the steps took less.
        p99_ms: 99 % of them took less.
        largest_ms: The slowest one.
        late: Steps that took longer than the period of ``frame_rate_hz``.
    """

    steps: int
    median_ms: float
    p99_ms: float
    largest_ms: float
    late: int


class LiveRobot:
    """A brain in a robot's own loop.

    ``step`` belongs to one thread, that of the camera. ``pose``, ``timing``, ``add_goal``,
    ``steer`` and ``save`` may be called from any: they wait for the step in progress.

    Args:
        config: Config of the brain; default: that of the stored map, or the default config.
        path: File of the brain: loaded if it is there, written by :meth:`save` and on exit. The
            stored map waits until it is recognised, after any time and on any clock; until then the
            robot makes a new map, which is then joined.
        on_event: Called with each :class:`Event`, in the thread of ``step``, after the step.

    Example:
        >>> from neuroslam import open_source
        >>> events = []
        >>> robot = LiveRobot(on_event=events.append)
        >>> for frame in open_source("world:corridor?frames_per_lap=110").frames(stop=3):
        ...     here = robot.step(frame.image, frame.time_s, velocity=(0.5, 0.0))
        >>> here.confidence > 0.9, here.result.experience
        (True, 2)
    """

    def __init__(
        self,
        config: BrainConfig | None = None,
        path: str | Path | None = None,
        on_event: Callable[[Event], object] | None = None,
    ) -> None:
        self.path = None if path is None else Path(path)
        self.on_event = on_event
        stored = load_brain(self.path) if self.path is not None and self.path.exists() else None
        self.brain = NavigationBrain(config or (stored.config if stored else BrainConfig()))
        if stored is not None:
            self.brain.store(stored)
        self.located: Located | None = None
        self._follower = PathFollower(self.brain)
        self._goal = NO_EXPERIENCE  # of the path that is followed
        self._lock = threading.RLock()
        self._frames = 0
        self._times_ms: deque[float] = deque(maxlen=_TIMES)
        self._alone_m = 0.0  # path since a view was recognised
        self._was_lost = False

    def step(
        self,
        image: np.ndarray | None,
        time_s: float,
        velocity: tuple[float, float] | None = None,
        ranges: np.ndarray | None = None,
        order: Order = "rgb",
        turn_rate_rad_s: float | None = None,
        v_z_m_s: float | None = None,
    ) -> Located:
        """Advance by one instant.

        Args:
            image: ``uint8``, ``(h, w, 3)`` or ``(h, w)``; ``None``: no picture at this instant.
            time_s: Seconds on any clock that rises: Unix time, or ``time.monotonic()``.
            velocity: Forward speed (m/s) and turn rate (rad/s, positive to the left) since the last
                step; ``None``: measured from the pictures.
            ranges: Metres at bearings evenly over the full turn, counter-clockwise from straight
                ahead.
            order: Order of the channels of the picture.
            turn_rate_rad_s: Of a gyroscope, since the last step; used by
                ``odometry.use = "fused"``.
            v_z_m_s: Speed upwards since the last step, for brains with ``pose_3d`` cells.

        Raises:
            BadFrame: If the time does not rise or a value is invalid. The state is unchanged, and
                the next step may follow.
        """
        picture = None if image is None else as_picture(image, order)
        motion = None if velocity is None else Velocity(*map(float, velocity))
        with self._lock:
            began_s = time.perf_counter()
            before, goals = self._known(), self.brain.map.goals
            waiting = {name: goals[name].clone() for name in goals.columns}
            frame = Frame(
                self._frames, time_s, picture, motion, ranges, turn_rate_rad_s=turn_rate_rad_s,
                v_z_m_s=v_z_m_s,
            )  # fmt: skip
            result = self.brain(frame)
            self._frames += 1
            if before[4] > self.brain.map.n or before[1] < len(self.brain.sessions.merges):
                self._follower.reset()  # experiences have other ids
            self._follower.moved(result.motion)
            self._settle_goal(waiting)
            self.located = Located(result.pose, self._confidence(result), result)
            self._times_ms.append(1e3 * (time.perf_counter() - began_s))
            events = [
                Event(kind, result.frame, result.time_s, result.experience)
                for kind in self._events(before, result)
            ]
            located = self.located
        for event in events:
            if self.on_event is not None:
                self.on_event(event)
        return located

    def _settle_goal(self, waiting: dict[str, torch.Tensor]) -> None:
        """Drop the goal at the end of the path; keep it while the views show the robot elsewhere.

        Args:
            waiting: Goals before this frame.
        """
        follower, map_, goals = self._follower, self.brain.map, self.brain.map.goals
        if not follower.path or not len(waiting["experience"]):
            return
        if int(waiting["experience"][0]) != follower.path[-1]:
            return
        dropped = goals.n < len(waiting["experience"])
        if dropped and follower.elsewhere() and float(waiting["until_s"][0]) > map_.state.time_s:
            goals.replace(**waiting)
        elif dropped:
            self._goal = NO_EXPERIENCE
        elif follower.arrived():
            goals.replace(**{name: goals[name][1:] for name in goals.columns})
            self._goal = NO_EXPERIENCE

    def _known(self) -> tuple[int, int, int, int, int]:
        """Count sessions of the map, merges, goals, links, experiences."""
        sessions, map_ = self.brain.sessions, self.brain.map
        return len(sessions.sessions), len(sessions.merges), map_.goals.n, map_.n_links, map_.n

    def _events(
        self, before: tuple[int, int, int, int, int], result: StepResult
    ) -> list[EventKind]:
        sessions, merges, goals, links, _ = self._known()
        found: list[EventKind] = []
        joined = merges > before[1]
        kidnapped = sessions > before[0] and self.brain.sessions.now.began == "kidnapped"
        if kidnapped and not joined:
            found.append("kidnapped")
        if joined:
            found.append("joined")
        elif (
            result.action == "link"
            and links > before[3]
            and result.n_experiences - result.experience > _EARLIER
        ):
            found.append("loop_closed")
        if not joined and (result.action == "set" or (self._was_lost and not result.lost)):
            found.append("relocalised")
        if goals < before[2]:
            found.append("goal_reached")
        self._was_lost = result.lost
        return found

    def _confidence(self, result: StepResult) -> float:
        if result.lost:
            return 0.0
        map_ = self.brain.map
        self._alone_m += abs(result.motion.v_m_s) * result.motion.dt_s
        old = map_.n - result.experience > _EARLIER
        if result.action in ("link", "set") or old or map_.n <= 1:
            self._alone_m = 0.0
        lengths = map_.links_table.array("distance_m")
        link_m = float(np.median(lengths)) if len(lengths) else 1.0
        return math.exp(-self._alone_m / (_KNOWN_LINKS * max(link_m, 1e-6)))

    @property
    def pose(self) -> Pose:
        """Pose on the map, m and rad."""
        with self._lock:
            return self.brain.map.pose

    @property
    def timing(self) -> Timing:
        """Times of the last steps, without the work of callbacks."""
        with self._lock:
            times = np.array(self._times_ms)
        if not len(times):
            return Timing(0, 0.0, 0.0, 0.0, 0)
        period_ms = 1e3 / self.brain.config.frame_rate_hz
        median, p99 = np.quantile(times, [0.5, 0.99]).tolist()
        return Timing(len(times), median, p99, float(times.max()), int((times > period_ms).sum()))

    def add_goal(self, experience: int, timeout_s: float = math.inf) -> None:
        """Append an experience to visit; it is dropped once it is reached.

        Raises:
            MapError: If there is no such experience, or the time is not positive.
        """
        with self._lock:
            self.brain.map.add_goal(experience, timeout_s)

    def reachable(self) -> list[int]:
        """Return the experiences that can be driven to from one another, along driven links.

        Links much longer than the others do not count if half of these experiences remain: what
        lies between is not known.
        """
        with self._lock:
            map_ = self.brain.map
            if not map_.n:
                return []
            links = map_.links
            short = links.distance_m <= _LONG_LINK * np.median(links.distance_m)
            sound = on_loops(tuple(column[short] for column in links), map_.n).tolist()
            every = on_loops(links, map_.n).tolist()
            return sound if 2 * len(sound) >= len(every) else every

    def plan(self, forward: bool = True) -> Plan:
        """Return the path to the first goal; empty without one.

        Args:
            forward: Follow links only in the direction in which they were driven, as a forward
                camera recognises nothing the other way.
        """
        with self._lock:
            goals = self.brain.map.goals["experience"].tolist()
            if not goals:
                return Plan([], math.inf, "there is no goal")
            found = self.brain.map.plan(goals[0], forward=forward)
            if found.path or not forward:
                return found
            start = self._beside(goals[0])
            return self.brain.map.plan(goals[0], start, forward)

    def _beside(self, goal: int) -> int:
        """Return the experience nearest in place and heading that leads to a goal."""
        map_ = self.brain.map
        pose, poses = map_.pose, map_.poses
        apart_m = np.hypot(poses[:, 0] - pose.x_m, poses[:, 1] - pose.y_m)
        lengths = map_.links_table.array("distance_m")
        link_m = float(np.median(lengths)) if len(lengths) else 1.0
        turned = 1.0 - np.cos(poses[:, 2] - pose.theta_rad)
        cost = apart_m + _TURN_LINKS * link_m * turned
        cost[~leads_to(map_.links, map_.n, goal)] = np.inf
        return int(cost.argmin())

    def steer(
        self,
        speed_m_s: float,
        look_ahead_m: float,
        forward: bool = True,
        largest_turn_rad_s: float = 6.0,
    ) -> Velocity | None:
        r"""Return the speed and turn rate that follow the plan, by pure pursuit.

        .. math:: \omega = 2 v \sin(\beta) / d

        with the distance :math:`d` and the bearing :math:`\beta` of the point of the path ahead; a
        robot that faces away from it turns first (R. Coulter, CMU-RI-TR-92-01, 1992). The robot
        knows its place on the path by odometry and by the views along it; where it recognises none
        it slows down, and then turns once on the spot to find itself. Where it does not move
        although it should, it backs first. See :mod:`neuroslam.runs.following`.

        Args:
            speed_m_s: Speed on a straight path.
            look_ahead_m: Distance along the path of the point that is steered for.
            forward: As for :meth:`plan`.
            largest_turn_rad_s: Limit of the turn rate.

        Returns:
            The command; ``None`` without a path to a goal.
        """
        with self._lock:
            follower, goals = self._follower, self.brain.map.goals["experience"].tolist()
            if follower.brain is not self.brain:  # another was set
                follower = self._follower = PathFollower(self.brain)
            if not goals:
                self._goal = NO_EXPERIENCE
                return None
            found = follower.found()
            if found is not None:
                self._take_path(found, ORIGIN, goals[0], forward)
            elif self._goal != goals[0] or not follower.path:
                known, pose = self.brain.map.current, self.brain.map.pose
                if follower.sure:
                    start, offset = follower.offset()
                else:
                    if not leads_to(self.brain.map.links, self.brain.map.n, goals[0])[known]:
                        known = self._beside(goals[0]) if forward else known
                    start = known
                    offset = relative(Pose(*self.brain.map.poses[known].tolist()), pose)
                self._take_path(start, offset, goals[0], forward)
            if not follower.path:
                return None
            return follower.command(speed_m_s, look_ahead_m, largest_turn_rad_s)

    def _take_path(self, start: int, offset: Pose, goal: int, forward: bool) -> None:
        """Follow the plan from an experience, relative to which the robot has a pose."""
        self._goal = goal
        path = self._path(start, goal, forward)
        if path:
            self._follower.take_path(path, offset)
        else:
            self._follower.reset()

    def _path(self, start: int, goal: int, forward: bool) -> list[int]:
        """Plan without links that failed, and if possible without long ones.

        Between the ends of a long link the robot may have driven a bend along other experiences.
        """
        links, n = self.brain.map.links, self.brain.map.n
        failed = self._follower.failed
        sound = [pair not in failed for pair in zip(*(c.tolist() for c in links[:2]), strict=True)]
        tried = np.array(sound, dtype=bool)
        longest = _LONG_LINK * float(np.median(links.distance_m)) if len(sound) else 0.0
        for kept in (tried & (links.distance_m <= longest), tried, np.ones_like(tried)):
            some = tuple(column[kept] for column in links)
            path = quickest_path(some, n, start, goal, forward).path
            if path:
                return path
        return []

    @property
    def following(self) -> Following:
        """How the robot follows its path."""
        with self._lock:
            return self._follower.now

    def save(self) -> None:
        """Write the brain to its file, atomically.

        Raises:
            ValueError: If the robot has no file.
        """
        if self.path is None:
            raise ValueError("LiveRobot: has no file; give path= to save the map")
        with self._lock:
            save_brain(self.brain, self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Save the map, whatever ended the loop, unless the robot has seen nothing."""
        if self.path is not None and self.brain.map.current != NO_EXPERIENCE:
            self.save()


def as_picture(image: np.ndarray, order: Order = "rgb") -> np.ndarray:
    """Return a picture as the brain takes it: RGB or grey, in memory of its own.

    Args:
        image: ``uint8``, ``(h, w, 3)``, ``(h, w, 1)`` or ``(h, w)``.
        order: Order of the channels.

    Raises:
        BadFrame: If the picture has another type or shape than the order says.

    Example:
        >>> blue = np.zeros((2, 2, 3), np.uint8); blue[..., 0] = 255
        >>> as_picture(blue, "bgr")[0, 0].tolist()
        [0, 0, 255]
    """
    if order not in ("rgb", "bgr", "grey"):
        raise BadFrame(f"picture: order {order!r}; expected rgb, bgr or grey")
    picture = np.asarray(image)
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[:, :, 0]
    if order == "grey" and picture.ndim != 2:
        raise BadFrame(f"picture: has shape {picture.shape} and order grey; expected (h, w)")
    picture = picture[:, :, ::-1] if order == "bgr" and picture.ndim == 3 else picture
    check_image(picture)
    return np.array(picture, order="C")
