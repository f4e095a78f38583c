r"""Follows a path of the map by odometry and by views, and finds back to it.

The robot keeps its pose :math:`q` relative to the path: the experiences of a plan, laid out by the
relative poses of their links, not by their coordinates on the map, so that a map which is distorted
far away does not matter. Odometry moves :math:`q`. In every frame the view is compared, at all
shifts of its columns, with those of the experiences nearby: the least match errors say how far
along the path the robot is, and the shifts by how much it is turned from it,

.. math:: \theta \leftarrow \theta + g \sum_k w_k\, (\theta_k + s_k / c - \theta), \qquad
          w_k \propto e^{-(e_k - \min e) / \tau}

with the heading :math:`\theta_k` of experience :math:`k`, the best shift :math:`s_k` in columns,
:math:`c` columns per radian and the match error :math:`e_k`. Beside the path, near things shift the
view as a turn away from it would, so that following these headings also leads back to the path:
teach and repeat by appearance (A. Zhang, L. Kleeman, IJRR 28, 2009; D. Dall'Osto, T. Fischer,
M. Milford, IROS 2021). Where no view is recognised the robot slows down, then turns once on the
spot, and goes on from the experience that it saw best.
"""

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.geometry import ORIGIN, TWO_PI, compose, relative, rotate, wrap_angle
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.types import NO_TEMPLATE, Motion, Pose, Velocity

Mode = Literal["follow", "back", "turn", "face"]
"""On the path; backing from an obstacle; turning on the spot to see where it is; turning to the
view that it saw best."""

_ALIKE = 0.75  # match error, as a share of the usual one, up to which a view is recognised
_NEAR = (2, 4)  # experiences behind and ahead that a view is compared with
_SAMPLE = 32  # experiences whose match error is the usual one
_SHARP = 0.08  # decay of the weight of an experience with its match error, in usual ones
_TURN_GAIN, _ALONG_GAIN = 0.3, 0.15  # of a view
_UNSEEN_LINKS = 3.0  # links without a recognised view after which the robot slows down
_LOST_LINKS = 8.0  # and after which it looks around
_BACK_LINKS = 1.5  # links that it backs from an obstacle
_STUCK_S = 0.5  # time without motion that shows an obstacle
_SLOW = 0.4  # share of the speed while no view is recognised
_SEARCH_SHARE = 0.35  # of the largest turn rate
_END_LINKS = 4  # links within which the map may say that the goal is reached
_FAR_SHARE = 0.03  # of the usual match error: cost of a link between belief and what is seen
_FAR_LINKS = 10.0  # beyond which more distance costs nothing


class Following(NamedTuple):
    """How a robot follows its path.

    Attributes:
        mode: What it does.
        experience: Experience of the path that it passed last.
        along_m: Path length from there.
        left_m: How far it is to the left of the path.
        turned_rad: How far it is turned to the left of the path.
        match: Least match error with the experiences nearby, as a share of the usual one.
        unseen_m: Path length since a view was recognised.
    """

    mode: Mode
    experience: int
    along_m: float
    left_m: float
    turned_rad: float
    match: float
    unseen_m: float


class Seen(NamedTuple):
    """A view beside those of some experiences.

    Attributes:
        errors: Match error with each at the best shift, in [0, 1], ``(n,)``.
        turned_rad: By how much the view is turned to the left of each, ``(n,)``.
    """

    errors: np.ndarray
    turned_rad: np.ndarray


def turned_views(
    view: np.ndarray, others: np.ndarray, most: int, columns_per_rad: float, panoramic: bool
) -> Seen:
    """Compare a view with others at all shifts of its columns; a parabola finds parts of a column.

    Args:
        view: ``uint8``, ``(width, height)``, column after column.
        others: ``uint8``, ``(n, width, height)``.
        most: Largest shift in columns.
        columns_per_rad: Columns of a radian.
        panoramic: The columns wrap around.

    Example:
        >>> stripe = np.zeros((12, 2), np.uint8); stripe[3:6] = [[90], [200], [90]]
        >>> seen = turned_views(np.roll(stripe, 2, axis=0), stripe[None], 4, 10.0, False)
        >>> seen.errors.tolist(), seen.turned_rad.round(2).tolist()
        ([0.0], [0.2])
    """
    now, then, width = view.astype(np.int16), others.astype(np.int16), len(view)
    apart = np.empty((2 * most + 1, len(others)))
    for row, s in enumerate(range(-most, most + 1)):
        if panoramic:
            difference = np.roll(now, -s, axis=0) - then
        else:
            difference = (
                now[max(s, 0) : width + min(s, 0)] - then[:, max(-s, 0) : width - max(s, 0)]
            )
        apart[row] = np.abs(difference).mean(axis=(1, 2))
    best, every = apart.argmin(axis=0), np.arange(len(others))
    inner = np.clip(best, 1, 2 * most - 1)
    before, at, after = (apart[inner + k, every] for k in (-1, 0, 1))
    bend = before - 2.0 * at + after
    bent = (inner == best) & (bend > 0.0)
    part = np.where(bent, 0.5 * (before - after) / np.where(bent, bend, 1.0), 0.0)
    return Seen(apart[best, every] / 255.0, (best - most + part) / columns_per_rad)


def lay_out(map_: ExperienceMap, path: list[int]) -> np.ndarray:
    """Return the poses of a path's experiences relative to the first, by its links, ``(n, 3)``.

    A link that was driven the other way is reversed; where two experiences are not linked, their
    poses on the map count.
    """
    links, poses = map_.links, map_.poses
    rows = {pair: i for i, pair in enumerate(zip(*(c.tolist() for c in links[:2]), strict=True))}

    def moved(row: int) -> Pose:
        length, direction = float(links.distance_m[row]), float(links.heading_rad[row])
        facing = float(links.facing_rad[row])
        return Pose(length * math.cos(direction), length * math.sin(direction), facing)

    laid = [ORIGIN]
    for a, b in pairwise(path):
        if (a, b) in rows:
            step = moved(rows[a, b])
        elif (b, a) in rows:
            step = relative(moved(rows[b, a]), ORIGIN)
        else:
            step = relative(Pose(*poses[a].tolist()), Pose(*poses[b].tolist()))
        laid.append(compose(laid[-1], step))
    return np.array(laid)


class PathFollower:
    """Pose of a robot relative to a path, and the command that follows it.

    Args:
        brain: Its map and its views; the brain is not changed.

    Attributes:
        path: Experiences of the path; empty: there is none.
        mode: What the robot does.
        failed: Links after which the robot was lost, from and to.
    """

    def __init__(self, brain: NavigationBrain) -> None:
        view = brain.config.view
        self.brain, self.mode = brain, "follow"
        self.mode: Mode
        self._width, self._panoramic = view.template_width, view.panoramic
        field = TWO_PI if view.panoramic else math.radians(brain.config.odometry.fov_deg)
        self._columns_per_rad = self._width / field
        self._most = self._width // 2 if view.panoramic else self._width // 3
        self.reset()

    def reset(self) -> None:
        """Forget the path, and where the robot is on it."""
        self.path: list[int] = []
        self.nodes, self.at, self.pose = np.empty((0, 3)), 0, ORIGIN
        self.failed: set[tuple[int, int]] = set()
        self._seen_at = 0
        self.match, self.unseen_m, self.link_m = 1.0, 0.0, 1.0
        self._stuck_s = self._backed_m = self._turned = 0.0
        self._best: tuple[float, int, float] = (math.inf, -1, 0.0)
        self._asked: Velocity | None = None
        self.mode = "follow"

    @property
    def now(self) -> Following:
        """How the robot follows its path."""
        along, left, turned = self._beside_path()
        here = self.path[self.at] if self.path else -1
        return Following(self.mode, here, along, left, turned, self.match, self.unseen_m)

    @property
    def sure(self) -> bool:
        """Whether the robot knows where on the path it is."""
        return bool(self.path) and self.unseen_m <= _UNSEEN_LINKS * self.link_m

    def take_path(self, path: list[int], start: Pose = ORIGIN) -> None:
        """Follow a path from now on.

        Args:
            path: Experiences, from where the robot is to the goal.
            start: Pose of the robot relative to the first.
        """
        lengths = self.brain.map.links_table.array("distance_m")
        self.link_m = max(float(np.median(lengths)), 1e-3) if len(lengths) else 1.0
        self.path, self.nodes, self.at = path, lay_out(self.brain.map, path), 0
        self._seen_at = 0
        if self.mode != "follow":  # it has just been seen
            self.unseen_m = 0.0
        self.pose, self.mode = start, "follow"
        self._pass_experiences()

    def offset(self) -> tuple[int, Pose]:
        """Return the experience that was passed last, and the pose of the robot relative to it."""
        return self.path[self.at], relative(Pose(*self.nodes[self.at].tolist()), self.pose)

    def arrived(self) -> bool:
        """Whether the robot is at the end of its path, and sees it."""
        if not self.path or self.mode != "follow" or not self.sure:
            return False
        if self.at < len(self.path) - 2:  # a lap ends beside its begin
            return False
        ahead, left = rotate(*self._to(len(self.path) - 1), -float(self.nodes[-1, 2]))
        return ahead <= 0.0 and abs(left) <= 2.0 * self.link_m

    def elsewhere(self) -> bool:
        """Whether views show the robot on the path, more than a few links before its end."""
        return self.sure and self.mode == "follow" and len(self.path) - 1 - self.at > _END_LINKS

    def moved(self, motion: Motion) -> None:
        """Take one frame: odometry, then the view."""
        if not self.path:
            return
        turn, way = motion.w_rad_s * motion.dt_s, motion.v_m_s * motion.dt_s
        step = Pose(way * math.cos(0.5 * turn), way * math.sin(0.5 * turn), turn)
        self.pose = compose(self.pose, step)
        self.unseen_m += abs(way)
        self._turned += turn
        self._backed_m -= way
        asked = 0.0 if self._asked is None else self._asked.v_m_s
        stalled = abs(asked) > 0.0 and abs(motion.v_m_s) < 0.1 * abs(asked)
        self._stuck_s = self._stuck_s + motion.dt_s if stalled else 0.0
        view = self.brain.continuity.before.numpy().reshape(self._width, -1)
        if self.mode in ("turn", "face"):
            self._look(view)
        else:
            self._pass_experiences()
            self._recognise(view)

    def command(self, speed_m_s: float, look_ahead_m: float, largest_turn_rad_s: float) -> Velocity:
        """Return the command of this moment; a path must have been given.

        Args as for :meth:`neuroslam.runs.live.LiveRobot.steer`.
        """
        limit = largest_turn_rad_s
        if self.mode == "follow" and self._stuck_s > _STUCK_S:
            self.mode, self._backed_m, self._stuck_s = "back", 0.0, 0.0
        elif self.mode == "follow" and self.unseen_m > _LOST_LINKS * self.link_m:
            self._look_around()
        if self.mode == "back" and (
            self._backed_m >= _BACK_LINKS * self.link_m or self._stuck_s > _STUCK_S
        ):
            self._look_around()
        if self.mode == "back":
            self._asked = Velocity(-0.5 * speed_m_s, 0.0)
        elif self.mode == "turn":
            self._asked = Velocity(0.0, _SEARCH_SHARE * limit)
        elif self.mode == "face":
            rest = wrap_angle(self._best[2] - self._turned)
            rate = min(_SEARCH_SHARE * limit, 4.0 * abs(rest) + 0.1)
            self._asked = Velocity(0.0, math.copysign(rate, rest))
        else:
            self._asked = self._pursue(speed_m_s, look_ahead_m, limit)
        return self._asked

    def found(self) -> int | None:
        """Return the experience that a robot which looked around goes on from, once it faces it."""
        if self.mode != "face" or abs(wrap_angle(self._best[2] - self._turned)) > 0.05:
            return None
        return self._best[1]

    def _pursue(self, speed_m_s: float, look_ahead_m: float, limit: float) -> Velocity:
        """Steer for the point of the path that lies ahead: pure pursuit."""
        along, _, _ = self._beside_path()
        target = self._point(along + look_ahead_m)
        ahead, left = rotate(
            target[0] - self.pose.x_m, target[1] - self.pose.y_m, -self.pose.theta_rad
        )
        bearing, apart_m = math.atan2(left, ahead), math.hypot(ahead, left)
        apart_m = max(apart_m, 0.5 * look_ahead_m)
        speed = speed_m_s if self.sure else _SLOW * speed_m_s
        if abs(bearing) > 0.4 * math.pi:  # on the spot
            return Velocity(0.0, math.copysign(_SEARCH_SHARE * limit, bearing))
        speed *= max(math.cos(bearing), 0.1)
        turn = 2.0 * speed * math.sin(bearing) / apart_m
        return Velocity(speed, min(max(turn, -limit), limit))

    def _to(self, node: int) -> tuple[float, float]:
        """Return the displacement from the robot to an experience of the path."""
        dx, dy = self.nodes[node, :2].tolist()
        return dx - self.pose.x_m, dy - self.pose.y_m

    def _beside_path(self) -> tuple[float, float, float]:
        """Return how far along its last link, to the left and turned the robot is."""
        if not self.path:
            return 0.0, 0.0, 0.0
        x, y, theta = self.nodes[self.at].tolist()
        direction, turned = self._direction(self.at), wrap_angle(self.pose.theta_rad - theta)
        along, left = rotate(self.pose.x_m - x, self.pose.y_m - y, -direction)
        return along, left, turned

    def _direction(self, node: int) -> float:
        """Return the direction of the path at an experience."""
        if node + 1 >= len(self.nodes):
            return float(self.nodes[node, 2])
        dx, dy = (self.nodes[node + 1, :2] - self.nodes[node, :2]).tolist()
        return math.atan2(dy, dx)

    def _point(self, ahead_m: float) -> tuple[float, float]:
        """Return the point of the path so far ahead of the last experience passed."""
        rest = max(ahead_m, 0.0)
        for k in range(self.at, len(self.nodes) - 1):
            dx, dy = (self.nodes[k + 1, :2] - self.nodes[k, :2]).tolist()
            length = math.hypot(dx, dy)
            if rest < length:
                x, y = self.nodes[k, :2].tolist()
                return x + dx * rest / length, y + dy * rest / length
            rest -= length
        x, y, theta = self.nodes[-1].tolist()
        return x + rest * math.cos(theta), y + rest * math.sin(theta)

    def _pass_experiences(self) -> None:
        """Advance to the experience that the robot passed last, or go back to it."""
        while self.at + 1 < len(self.path):
            dx, dy = (self.nodes[self.at + 1, :2] - self.nodes[self.at, :2]).tolist()
            length = max(math.hypot(dx, dy), 1e-6)
            if self._beside_path()[0] < length:
                break
            self.at += 1
        while self.at > 0 and self._beside_path()[0] < -1e-6:
            dx, dy = (self.nodes[self.at, :2] - self.nodes[self.at - 1, :2]).tolist()
            self.at -= 1
            if self._beside_path()[0] < math.hypot(dx, dy):
                break

    def _templates(self, experiences: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which experiences have a view, and these views, ``(n, width, height)``."""
        templates = self.brain.map.experiences.array("template")[experiences]
        with_view = np.flatnonzero(templates != NO_TEMPLATE)
        pixels = self.brain.view.templates.array("pixels")[templates[with_view]]
        return with_view, pixels.reshape(len(with_view), self._width, -1)

    def _usual(self, view: np.ndarray) -> float:
        """Return the mean match error with views from all over the map."""
        n = self.brain.map.n
        _, pixels = self._templates(np.unique(np.linspace(0, n - 1, _SAMPLE).astype(int)))
        if not len(pixels):
            return 1.0
        apart = np.abs(pixels.astype(np.int16) - view.astype(np.int16)).mean()
        return max(float(apart) / 255.0, 1e-6)

    def _recognise(self, view: np.ndarray) -> None:
        """Correct heading and place along the path by the views of the experiences nearby."""
        low, high = max(self.at - _NEAR[0], 0), min(self.at + _NEAR[1], len(self.path))
        with_view, pixels = self._templates(np.array(self.path[low:high]))
        if not len(pixels):
            return
        seen = turned_views(view, pixels, self._most, self._columns_per_rad, self._panoramic)
        relative_errors = seen.errors / self._usual(view)
        self.match = float(relative_errors.min())
        if self.match > _ALIKE:
            return
        self.unseen_m, self._seen_at = 0.0, self.at
        weight = np.exp(-(relative_errors - self.match) / _SHARP)
        weight /= weight.sum()
        nodes = self.nodes[low + with_view]
        turned = np.array(
            [
                wrap_angle(float(theta) + float(t) - self.pose.theta_rad)
                for theta, t in zip(nodes[:, 2], seen.turned_rad, strict=True)
            ]
        )
        turn = _TURN_GAIN * float(weight @ turned)
        direction = self._direction(self.at)
        ahead = (nodes[:, 0] - self.pose.x_m) * math.cos(direction)
        ahead += (nodes[:, 1] - self.pose.y_m) * math.sin(direction)
        along = float(weight @ np.clip(ahead, -2.0 * self.link_m, 2.0 * self.link_m))
        along *= _ALONG_GAIN
        self.pose = Pose(
            self.pose.x_m + along * math.cos(direction),
            self.pose.y_m + along * math.sin(direction),
            wrap_angle(self.pose.theta_rad + turn),
        )
        self._pass_experiences()

    def _look_around(self) -> None:
        if self._seen_at + 1 < len(self.path):
            self.failed.add((self.path[self._seen_at], self.path[self._seen_at + 1]))
        self.mode, self._turned, self._stuck_s = "turn", 0.0, 0.0
        self._best = (math.inf, -1, 0.0)

    def _look(self, view: np.ndarray) -> None:
        """Remember which experience is seen best while the robot turns on the spot."""
        if self.mode == "face":
            return
        errors, _ = self.brain.view.compare(view.T / 255.0)
        map_, usual = self.brain.map, self._usual(view)
        templates = map_.experiences.array("template")
        match = np.append(errors, np.inf)[templates] / usual
        here = map_.poses[self.path[self.at], :2]
        apart = np.hypot(*(map_.poses[:, :2] - here).T) / self.link_m
        match = match + _FAR_SHARE * np.minimum(apart, _FAR_LINKS)
        match[~self.useful()] = np.inf
        best = int(match.argmin())
        if match[best] < self._best[0]:
            self._best = (float(match[best]), best, self._turned)
        if abs(self._turned) >= TWO_PI:
            if self._best[1] < 0:
                self._look_around()
            else:
                self.mode = "face"

    def useful(self) -> np.ndarray:
        """Return which experiences lead to the end of the path, ``(n,)`` bool."""
        from neuroslam.mapping.planning import leads_to

        return leads_to(self.brain.map.links, self.brain.map.n, self.path[-1])
