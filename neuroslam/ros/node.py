"""The logic of the node, without ROS: messages and times go in, poses and maps come out."""

import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.errors import BadFrame, NeuroslamError, counted
from neuroslam.geometry import compose, relative
from neuroslam.ros.settings import RosSettings
from neuroslam.ros.streams import Instant, MessageStreams
from neuroslam.runs.foxglove import link_length
from neuroslam.runs.live import _KNOWN_LINKS, Event, LiveRobot
from neuroslam.runs.reading import trajectory
from neuroslam.sensors.bag_images import grey_of
from neuroslam.sensors.bag_odometry import OdometrySample, motion_between, odometry_sample
from neuroslam.sensors.full_turn import full_turn
from neuroslam.sensors.pixels import PixelScale
from neuroslam.types import Pose, Velocity

LOST_M2, LOST_RAD2 = 1e6, math.pi**2
"""Variances of the pose of a lost robot."""


class MapTransform(NamedTuple):
    """A frame and the pose of another in it, at a time."""

    time_s: float
    parent: str
    child: str
    pose: Pose


class MapPose(NamedTuple):
    """Pose of the robot on the map.

    Attributes:
        time_s: Its time.
        frame: Frame of the map.
        pose: The pose.
        variance: Of x and of y in m², and of the heading in rad², see :func:`variance_of`.
    """

    time_s: float
    frame: str
    pose: Pose
    variance: tuple[float, float, float]


class MapGraph(NamedTuple):
    """Experiences, ``(n, 3)``, links between them, ``(m, 2)``, and the median length of a link."""

    time_s: float
    frame: str
    poses: np.ndarray
    links: np.ndarray
    link_m: float


class MapPath(NamedTuple):
    """Poses along a path, ``(n, 3)``: the one driven on the present map, or a plan."""

    time_s: float
    frame: str
    poses: np.ndarray


class MapEvent(NamedTuple):
    """Something that happened, see :class:`neuroslam.runs.live.Event`."""

    time_s: float
    text: str


Output = MapTransform | MapPose | MapGraph | MapPath | MapEvent


class Answer(NamedTuple):
    """Answer of a service: whether it was done, and in words what."""

    done: bool
    text: str
    path: MapPath | None = None


class MappingNode:
    """Maps what messages say. All methods may be called from any thread.

    A message is any object with the fields of ROS's: ``sensor_msgs`` ``Image``, ``CompressedImage``
    and ``LaserScan``, ``nav_msgs/Odometry``, of ROS 1, ROS 2 or rosbags. Times are given beside
    them, as the two versions write them differently.

    Args:
        settings: Parameters.
        log: Called with each line that a person should read.

    Raises:
        ConfigError: If the config of the brain is invalid.
        CheckpointError: If there is a stored map that cannot be read.
    """

    def __init__(self, settings: RosSettings, log: Callable[[str], object] = print) -> None:
        self.settings, self.log = settings, log
        self.refused = 0  # messages
        self._lock = threading.RLock()
        self._events: list[Event] = []
        self._path = Path(settings.map_file) if settings.map_file else None
        self._config = settings.brain_config()
        self._streams = MessageStreams(
            bool(settings.image_topic), bool(settings.odometry_topic), settings.lag_s
        )
        self._scale, self._images = PixelScale(), 0
        self._ranges: np.ndarray | None = None
        self._sample: OdometrySample | None = None
        self._frames = settings.odom_frame, settings.base_frame
        self._begin()

    def _begin(self) -> None:
        self.robot = LiveRobot(self._config, self._path, self._events.append)
        self._track: list[tuple[int, int, Pose]] = []
        self._graph_due_s = -math.inf

    def warm_up(self) -> None:
        """Step a brain that is then thrown away: the first steps load or compile, for seconds."""
        picture = np.tile(np.arange(80, dtype=np.uint8), (60, 1))
        robot = LiveRobot(self.robot.brain.config)
        for k in range(3):
            robot.step(np.roll(picture, 8 * k, axis=1), 0.1 * k, (0.1, 0.0))

    def on_image(self, message: Any, time_s: float) -> list[Output]:  # noqa: ANN401
        """Process an image, raw or compressed; return what is to be published."""
        with self._lock:
            try:
                rule = self.robot.brain.config.view.grey
                image = grey_of(message, rule, self._scale, self._images)
                self._images += 1
                self._streams.add_image(time_s, image)
            except BadFrame as error:
                self._refuse(error)
                return []
            return self._advance()

    def on_scan(self, message: Any) -> None:  # noqa: ANN401
        """Keep a scan for the next sample of odometry."""
        try:
            ranges = full_turn(message.ranges, message.angle_min, message.angle_increment,
                               message.range_min, message.range_max)  # fmt: skip
        except BadFrame as error:
            self._refuse(error)
            return
        with self._lock:
            self._ranges = ranges

    def on_odometry(self, message: Any, time_s: float) -> list[Output]:  # noqa: ANN401
        """Process a sample of odometry; return what is to be published."""
        with self._lock:
            try:
                sample = odometry_sample(message, time_s)
                velocity = self._velocity(sample)
                pose = Pose(sample.x_m, sample.y_m, sample.heading_rad)
                known = pose if np.isfinite(pose).all() else None
                self._streams.add_odometry(time_s, velocity, self._ranges, known)
            except BadFrame as error:
                self._refuse(error)
                return []
            odom, base = self.settings.odom_frame, self.settings.base_frame
            self._frames = (
                odom or message.header.frame_id or "odom",
                base or message.child_frame_id or "base_link",
            )
            return self._advance()

    def _velocity(self, sample: OdometrySample) -> Velocity:
        if self.settings.motion == "poses":
            before = self._sample or sample._replace(time_s=sample.time_s - 1.0)
            if not sample.time_s > before.time_s:
                raise BadFrame(f"odometry: its time {sample.time_s:.6f} s does not rise")
            velocity = motion_between(before, sample)
        else:
            velocity = Velocity(sample.vx_m_s, sample.w_rad_s)
        if not np.isfinite(velocity).all():
            raise BadFrame(f"odometry: {velocity.v_m_s} m/s, {velocity.w_rad_s} rad/s")
        self._sample = sample
        return velocity

    def _refuse(self, error: BadFrame) -> None:
        self.refused += 1
        self.log(f"refused: {error}")

    def _advance(self) -> list[Output]:
        found: list[Output] = []
        for instant in self._streams.ready():
            try:
                found += self._step(instant)
            except BadFrame as error:
                self._refuse(error)
        return found

    def _step(self, instant: Instant) -> list[Output]:
        self._events.clear()
        given = instant.velocity
        motion = None if given is None else (given.v_m_s, given.w_rad_s)
        here = self.robot.step(instant.image, instant.time_s, motion, instant.ranges)
        brain, frame, time_s = self.robot.brain, self.settings.map_frame, instant.time_s
        origin = brain.map.origin
        if origin[1] >= 0 and (not self._track or self._track[-1][:2] != origin):
            self._track.append((*origin, brain.map.offset))
        config = brain.config.map
        variance = variance_of(here.confidence, config.sigma_m, config.sigma_rad)
        found: list[Output] = [MapPose(time_s, frame, here.pose, variance)]
        if self.settings.publish_tf and (transform := self._transform(here.pose, instant)):
            found.append(transform)
        found += [MapEvent(e.time_s, f"{e.kind} {e.experience}") for e in self._events]
        if time_s >= self._graph_due_s and brain.map.n:
            self._graph_due_s = time_s + self.settings.graph_every_s
            found += [self.graph(time_s), self.path(time_s)]
        return found

    def _transform(self, pose: Pose, instant: Instant) -> MapTransform | None:
        """Return the pose of the frame of odometry on the map, or without odometry the robot's."""
        time_s = instant.time_s + self.settings.transform_tolerance_s
        parent = self.settings.map_frame
        if not self.settings.odometry_topic:
            return MapTransform(time_s, parent, self._frames[1] or "base_link", pose)
        if instant.odometry is None:
            return None
        origin = relative(instant.odometry, Pose(0.0, 0.0, 0.0))
        return MapTransform(time_s, parent, self._frames[0], compose(pose, origin))

    def graph(self, time_s: float) -> MapGraph:
        """Return experiences and links as they are now."""
        with self._lock:
            map_ = self.robot.brain.map
            links = map_.links
            ends = np.column_stack([links.source, links.target])
            poses = map_.poses.copy()
            return MapGraph(time_s, self.settings.map_frame, poses, ends, link_length(links))

    def path(self, time_s: float) -> MapPath:
        """Return the path driven, a pose for each experience visited, on the map as it is now."""
        with self._lock:
            rows = np.array([(s, n, *o) for s, n, o in self._track], np.float64).reshape(-1, 5)
            names = ("session", "number", "dx_m", "dy_m", "dtheta_rad")
            poses = trajectory(self.robot.brain, dict(zip(names, rows.T, strict=True)))
            known = np.isfinite(poses).all(axis=1)
            return MapPath(time_s, self.settings.map_frame, poses[known])

    @property
    def waiting(self) -> str:
        """What the node waits for; empty if all sensors have begun."""
        topics = {"image": self.settings.image_topic, "odometry": self.settings.odometry_topic}
        with self._lock:
            missing = self._streams.missing
        return "".join(f"no {kind} on {topics[kind]} yet; " for kind in missing).removesuffix("; ")

    def save(self) -> Answer:
        """Save the map to ``map_file``, atomically."""
        if self._path is None:
            return Answer(False, "there is no parameter map_file")
        with self._lock:
            n = self.robot.brain.map.n
            if not n:
                return Answer(False, "the map is empty; nothing was saved")
            try:
                self.robot.save()
            except (OSError, NeuroslamError) as error:
                return Answer(False, f"{self._path}: {error}")
        return Answer(True, f"{counted(n, 'experience')} in {self._path}")

    def load(self) -> Answer:
        """Drop the present map and take the one of ``map_file``, joined once it is recognised."""
        if self._path is None:
            return Answer(False, "there is no parameter map_file")
        if not self._path.exists():
            return Answer(False, f"{self._path}: is not there")
        with self._lock:
            try:
                self._begin()
            except NeuroslamError as error:
                return Answer(False, str(error))
            n = self.robot.brain.stored[0].map.n
        return Answer(True, f"{counted(n, 'experience')}; they are joined once recognised")

    def localise(self) -> Answer:
        """Forget where the robot is: the map waits until the robot is found on it again."""
        with self._lock:
            if not self.robot.brain.map.n:
                return Answer(False, "the map is empty")
            self.robot.brain.start_new_map("kidnapped")
        return Answer(True, "the map is joined once the robot is recognised on it")

    def goal(self, x_m: float, y_m: float) -> Answer:
        """Set the experience nearest to a position as the goal, and plan the path to it."""
        with self._lock:
            map_ = self.robot.brain.map
            if not map_.n:
                return Answer(False, "the map is empty")
            if not (math.isfinite(x_m) and math.isfinite(y_m)):
                return Answer(False, f"goal {x_m}, {y_m}; expected finite numbers")
            nearest = int(np.hypot(*(map_.poses[:, :2] - (x_m, y_m)).T).argmin())
            map_.goals.replace(**{name: map_.goals[name][:0] for name in map_.goals.columns})
            self.robot.add_goal(nearest)
            plan = self.robot.plan()
            time_s = self.robot.located.result.time_s if self.robot.located else 0.0
            path = MapPath(time_s, self.settings.map_frame, map_.poses[plan.path].reshape(-1, 3))
        if not plan.path:
            return Answer(False, plan.reason, path)
        text = f"experience {nearest}, {counted(len(plan.path) - 1, 'link')}"
        return Answer(True, text, path)

    def close(self) -> Answer:
        """Save the map at the end, if ``save_on_exit`` says so and there is one."""
        if self._path is None or not self.settings.save_on_exit or not self.robot.brain.map.n:
            return Answer(False, "nothing to save")
        return self.save()


def variance_of(confidence: float, sigma_m: float, sigma_rad: float) -> tuple[float, float, float]:
    r"""Return the variances of x, y and heading that a confidence stands for.

    .. math:: \sigma^2 (1 + n), \quad n = -20 \ln c

    with the links :math:`n` that odometry alone was followed since a view was recognised, each with
    the standard deviations of the config. It says how old the last recognition is; it is not the
    covariance of the map. A lost robot, :math:`c = 0`, has 10⁶ m² and π² rad².

    Args:
        confidence: :math:`c`, that of :class:`~neuroslam.runs.live.Located`.
        sigma_m: Standard deviation of the position of a link.
        sigma_rad: Standard deviation of its heading.

    Example:
        >>> variance_of(1.0, 0.1, 0.2) == (0.1**2, 0.1**2, 0.2**2)
        True
    """
    if confidence <= 0.0:
        return LOST_M2, LOST_M2, LOST_RAD2
    links = 1.0 - _KNOWN_LINKS * math.log(confidence)
    position = min(sigma_m**2 * links, LOST_M2)
    return position, position, min(sigma_rad**2 * links, LOST_RAD2)
