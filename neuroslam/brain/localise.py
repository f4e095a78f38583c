r"""Find the robot in a finished map and follow it there; the map is not changed.

The path of the last frames, from odometry, is laid at every experience :math:`e` that resembles the
present frame, as if the robot were there now. Where the path comes to lie, the map has experiences
whose views the earlier frames should resemble too:

.. math:: S_e = \frac{1}{|K|} \sum_{k \in K} \min_{j \,\in\, N(p_e \oplus r_k)} z_{t-k,\,j}

with the standardised match errors :math:`z`, the pose :math:`r_k` of frame :math:`t - k` in the
frame of the present one, and the experiences :math:`N` near a pose, farther where odometry has
drifted for longer. This is the sequence of SeqSLAM (:mod:`neuroslam.view.sequence`) along the
robot's own path instead of a straight line, so it also holds where the path branches or speed
changes.

Where odometry is poor the path comes to lie beside the map, so evidence is also accumulated along
the links of the map, as while mapping (:mod:`neuroslam.mapping.sequence`). Either is enough; a
belief by the links has to show the same place for longer.
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from neuroslam.brain.brain import NavigationBrain
from neuroslam.errors import BadFrame, MapError
from neuroslam.geometry import compose, compose_poses, integrate_velocities, relative_poses
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.sequence import advance_costs, relative_errors, within_links
from neuroslam.merging.limits import WINDOW, tolerance
from neuroslam.odometry import FlowOdometry, visual_odometry
from neuroslam.sensors.frames import check_instant, checked_odometry
from neuroslam.types import NO_EXPERIENCE, NO_TEMPLATE, Frame, Pose
from neuroslam.view.sequence import standardised

FRAMES = 20
"""Frames of the path that is laid on the map; every second one is compared."""

LARGEST_ERROR, LARGEST_RATIO = 0.75, 0.75
"""Evidence for a belief: mean match error along the path as a share of that with all experiences,
whatever the views are made of, and runner-up score over best score. Fixed on other drives than
those that are reported."""

AGREE = 3
"""Frames in a row whose evidence must agree before the robot is found, or found elsewhere."""

LINKS_LARGEST_SHARE = {True: 0.8, False: 0.7}
"""Evidence along the links for a belief: largest mean match error as a share of that with all
experiences, for views of gradients and for others, whose errors differ more between places."""

LINKS_LEAST_LEAD, LINKS_AGREE = 0.3, 4
"""Lead over any other part of the map in standard deviations, and frames in a row that agree."""

LEAST_FRAMES, LEAST_PATH = 8, 0.5
"""Frames of a path that are evidence, and its length in sizes of an experience."""

_MEMORY = 14  # frames over which evidence along the links is averaged
_APART = 6  # links within which experiences are the same part of the map
_AHEAD = (2, 4)  # links behind and ahead at which successive frames agree
_SAME = 2.5  # and distance, in median links, within which they are

_CANDIDATES = 100  # experiences that resemble the present frame most
_NEIGHBOURS = 4  # experiences near a pose that are compared with a frame
_COAST = 6.0  # distance, in sizes of an experience, that odometry alone is believed


class Localisation(NamedTuple):
    """Where the robot is in a map.

    Attributes:
        frame: Number of the frame.
        time_s: Its time.
        pose: Pose in the map; ``None``: not found.
        experience: Experience there.
        confidence: 1 minus the runner-up ratio in [0, 1], lower the longer odometry alone is
            followed; 0 if not found.
        error: Mean match error along the path at the best experience, found or not; NaN: none.
        ratio: Runner-up score over best score, in [0, 1]; 1: another place matches as well.
    """

    frame: int
    time_s: float
    pose: Pose | None
    experience: int
    confidence: float
    error: float
    ratio: float


class _Seen(NamedTuple):
    """A frame of the path: its pose by odometry, and its views' match errors by experience."""

    pose: Pose
    path_m: float
    z: np.ndarray
    errors: np.ndarray


class _Laid(NamedTuple):
    """Scores and mean match errors of the path laid at some experiences; errors also as shares."""

    scores: np.ndarray
    errors: np.ndarray
    shares: np.ndarray


class _OnLinks(NamedTuple):
    """Where the evidence along the links says that the robot is.

    Attributes:
        experience: The one with most evidence.
        ratio: That of the best elsewhere over it, in [0, 1].
        believed: Whether it is enough for a belief.
    """

    experience: int
    ratio: float
    believed: bool


class _LinkEvidence:
    """Evidence of successive frames along the links of a map."""

    def __init__(self, map_: ExperienceMap, largest_share: float) -> None:
        self.largest_share = largest_share
        self.source, self.target = (
            map_.links_table.array(name).copy() for name in ("source", "target")
        )
        self.xy = map_.poses[:, :2].copy()
        lengths_m = map_.links_table.array("distance_m")
        self.same_m = _SAME * float(np.median(lengths_m)) if len(lengths_m) else 0.0
        self.forget()

    def forget(self) -> None:
        """Begin again: the robot may be anywhere."""
        self.costs = np.zeros(len(self.xy))
        self.frames, self.agreeing, self.before = 0, 0, NO_EXPERIENCE
        self.share = 0.0

    def add(self, errors: np.ndarray) -> _OnLinks:
        """Take in the match errors of a frame with all experiences, ``(n,)``."""
        relative = relative_errors(errors, np.ones(len(errors), dtype=bool))
        memory = min(1.0 - 1.0 / _MEMORY, self.frames / (self.frames + 1.0))
        self.costs = advance_costs(self.costs, relative, self.source, self.target, memory)
        best = int(self.costs.argmin())
        share = float(errors[best] / errors.mean())
        self.share += (1.0 - memory) * (share - self.share)
        self.frames += 1
        follows = self.before != NO_EXPERIENCE and self._near(self.before, *_AHEAD)[best]
        self.agreeing = self.agreeing + 1 if follows else 0
        self.before = best
        rival = self.costs.min(where=~self._near(best, _APART, _APART), initial=0.0)
        lead = rival - self.costs[best]
        believed = (
            self.frames >= LEAST_FRAMES
            and self.agreeing >= LINKS_AGREE
            and self.share <= self.largest_share
            and lead >= LINKS_LEAST_LEAD
        )
        ratio = float(np.clip(rival / min(self.costs[best], -1e-9), 0.0, 1.0))
        return _OnLinks(best, ratio, believed)

    def _near(self, experience: int, back: int, ahead: int) -> np.ndarray:
        links = within_links(experience, back, ahead, self.source, self.target, len(self.xy))
        apart_m = np.hypot(*(self.xy - self.xy[experience]).T)
        return np.asarray(links | (apart_m <= self.same_m))


class Localiser:
    """Localises frames in a map that is not changed.

    The search is global in each frame, so a kidnapped robot is found again. The state is no part
    of a checkpoint: it is made again from the next frames.

    Args:
        brain: A finished map with views. Its templates and poses are read only.

    Raises:
        MapError: If the map has no views.

    Example:
        >>> from neuroslam import BrainConfig, open_source
        >>> brain = NavigationBrain(BrainConfig())
        >>> for frame in open_source("world:corridor?frames_per_lap=110").frames(stop=80):
        ...     result = brain(frame)
        >>> found = Localiser(brain)
        >>> again = open_source("world:corridor?frames_per_lap=110&gain=0.9").frames(20, 50)
        >>> poses = [found(frame).pose for frame in again]
        >>> poses[0] is None, poses[-1] is None
        (True, False)
    """

    def __init__(self, brain: NavigationBrain) -> None:
        self.brain, self.config = brain, brain.config
        self._templates = brain.map.experiences["template"].numpy(force=True).copy()
        self._own = np.flatnonzero(self._templates != NO_TEMPLATE)  # experiences with views
        if not len(self._own) or not brain.view.n:
            raise MapError(
                "the map has no views to compare images with; expected one that was made from "
                "images"
            )
        limits = tolerance([brain.map], brain.config)
        self.place_m, self.drift = limits.place_m, limits.drift
        # Beyond this distance views are not similar by proximity, as in merging.limits.elsewhere.
        self._elsewhere_m = limits.near_m / (2.0 * WINDOW)
        self.poses = brain.map.poses.copy()
        panoramic = self.config.view.panoramic
        self._turn_scale_m = 0.0 if panoramic else limits.place_m / limits.turn_rad
        self._points = self._coordinates(self.poses[self._own])
        from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

        self._tree = cKDTree(self._points)
        self._odometry = visual_odometry(self.config.odometry, self.config.view.grey)
        self._path: deque[_Seen] = deque(maxlen=FRAMES)
        share = LINKS_LARGEST_SHARE[bool(self.config.view.orientations)]
        self._links = _LinkEvidence(brain.map, share)
        self._here, self._path_m = Pose(0.0, 0.0, 0.0), 0.0
        self._time_s: float | None = None
        self._moves = False
        self._belief: tuple[Pose, int, float, float] | None = None  # pose, id, confidence, path
        self._agreeing: list[tuple[Pose, Pose]] = []  # laid and driven poses of the last evidence

    def _coordinates(self, poses: np.ndarray) -> np.ndarray:
        """Return points whose distance grows with that of positions and of headings."""
        scale = self._turn_scale_m
        turned = scale * np.stack([np.cos(poses[..., 2]), np.sin(poses[..., 2])], axis=-1)
        return np.concatenate([poses[..., :2], turned], axis=-1)

    def __call__(self, frame: Frame) -> Localisation:
        """Localise a frame.

        Raises:
            BadFrame: If its time does not rise, or it has neither odometry nor an image.
        """
        self._move(frame)
        estimate = self._estimate(frame)
        if estimate is None:
            self._agreeing.clear()
            return self._answer(frame, np.nan, 1.0)
        experience, turn_rad, error, share, ratio, on_links = estimate
        far = self._path[-1].path_m - self._path[0].path_m >= LEAST_PATH * self.place_m
        enough = far and len(self._path) >= LEAST_FRAMES
        good = enough and share <= LARGEST_ERROR and ratio <= LARGEST_RATIO
        if not good and far and on_links is not None and on_links.believed:
            good, experience, ratio = True, on_links.experience, on_links.ratio
        x_m, y_m, theta_rad = self.poses[experience].tolist()
        laid = Pose(x_m, y_m, theta_rad + turn_rad)
        if good and self._agrees(laid):
            self._belief = laid, experience, 1.0 - ratio, self._path_m
        elif not good:
            self._agreeing.clear()
        return self._answer(frame, error, ratio)

    def _move(self, frame: Frame) -> None:
        """Advance the dead-reckoned pose and the belief."""
        check_instant(frame)
        dt_s = 1.0 / self.config.frame_rate_hz
        if self._time_s is not None:
            dt_s = frame.time_s - self._time_s
            if not dt_s > 0.0:
                raise BadFrame(f"time {frame.time_s} s does not follow {self._time_s} s")
        use = self.config.odometry.use
        if use == "fused" and frame.image is not None and isinstance(self._odometry, FlowOdometry):
            given = None if frame.velocity is None else checked_odometry(frame.velocity)
            velocity = self._odometry(frame.image, dt_s, given)
        elif use != "visual" and frame.velocity is not None:
            velocity = checked_odometry(frame.velocity)
        elif use == "given" or frame.image is None:
            raise BadFrame("no odometry in the source, and no image to measure it by")
        else:
            velocity = self._odometry(frame.image, dt_s)
        self._time_s = frame.time_s
        if dt_s > self.config.max_gap_s:  # the motion in the gap is unknown
            self._path.clear()
            self._links.forget()
            self._agreeing.clear()
            self._belief = None
            return
        self._moves = velocity != (0.0, 0.0)
        moved = integrate_velocities(
            np.array([velocity.v_m_s]), np.array([velocity.w_rad_s]), np.array([dt_s])
        )
        step = Pose(*moved[-1].tolist())
        self._here = compose(self._here, step)
        self._path_m += abs(velocity.v_m_s) * dt_s
        if self._belief is not None:
            pose, experience, confidence, since_m = self._belief
            self._belief = compose(pose, step), experience, confidence, since_m

    def _estimate(
        self, frame: Frame
    ) -> tuple[int, float, float, float, float, _OnLinks | None] | None:
        """Lay the path; return experience, relative heading, match error, its share, and ratio."""
        view = None if frame.image is None else self.brain.view.usable_view(frame.image)
        if view is None:
            return None
        errors, turns = self.brain.view.differences_and_turns(view, np.arange(self.brain.view.n))
        templates = self._templates[self._own]
        z = standardised(errors)[templates]
        self._path.append(_Seen(self._here, self._path_m, z, errors[templates]))
        turns_rad = turns[templates]
        near = self._resembling(z, np.ones(len(z), dtype=bool))
        laid = self._lay(near, turns_rad)
        best = int(laid.scores.argmin())
        apart = np.linalg.norm(self._points - self._points[near[best]], axis=1)
        elsewhere = self._resembling(z, apart > self._elsewhere_m)
        ratio = 1.0
        if laid.scores[best] < 0.0:
            others = self._lay(elsewhere, turns_rad).scores if len(elsewhere) else np.zeros(1)
            ratio = float(np.clip(others.min() / laid.scores[best], 0.0, 1.0))
        error, share = float(laid.errors[best]), float(laid.shares[best])
        on_links = None
        if self._moves:
            on_links = self._links.add(np.append(errors, 1.0)[self._templates])
        at, turn_rad = int(self._own[near[best]]), float(turns_rad[near[best]])
        return at, turn_rad, error, share, ratio, on_links

    @staticmethod
    def _resembling(z: np.ndarray, among: np.ndarray) -> np.ndarray:
        """Return which of some experiences resemble a frame most."""
        some = np.flatnonzero(among)
        if len(some) <= _CANDIDATES:
            return some
        return some[np.argpartition(z[some], _CANDIDATES)[:_CANDIDATES]]

    def _lay(self, at: np.ndarray, turns_rad: np.ndarray) -> _Laid:
        """Lay the path at experiences; a frame that comes to lie off the map scores 0."""
        seen = [*self._path][::-2]
        now = seen[0]
        driven = relative_poses(np.array(now.pose), np.array([one.pose for one in seen]))
        starts = self.poses[self._own[at]]
        starts[:, 2] += turns_rad[at]
        laid = compose_poses(starts[:, None], driven[None])
        reach_m = self.place_m + self.drift * np.array([now.path_m - one.path_m for one in seen])
        apart_m, which = self._tree.query(
            self._coordinates(laid), k=min(_NEIGHBOURS, len(self._own)),
            distance_upper_bound=float(reach_m.max()),
        )  # fmt: skip
        apart_m, which = (a.reshape(*laid.shape[:2], -1) for a in (apart_m, which))
        on_map = apart_m <= reach_m[None, :, None]
        which = np.where(on_map, which, 0)
        rows = np.arange(len(seen))[None, :, None]
        z, errors = (np.array([getattr(one, name) for one in seen]) for name in ("z", "errors"))
        scores = np.where(on_map, z[rows, which], np.inf).min(axis=2)
        least = np.where(on_map, errors[rows, which], np.inf).min(axis=2)
        usual = errors.mean(axis=1)
        off = np.isinf(scores)
        error = np.where(off, usual[None], least).mean(axis=1)
        return _Laid(np.where(off, 0.0, scores).mean(axis=1), error, error / usual.mean())

    def _agrees(self, laid: Pose) -> bool:
        """Return whether this evidence agrees with the belief, or with that of enough frames."""
        if self._belief is not None and self._close(laid, self._belief[0]):
            self._agreeing.clear()
            return True
        if self._agreeing:
            before, driven = self._agreeing[-1]
            step = relative_poses(np.array(driven), np.array(self._here))
            expected = Pose(*compose_poses(np.array(before), step).tolist())
            if not self._close(laid, expected):
                self._agreeing.clear()
        self._agreeing.append((laid, self._here))
        if len(self._agreeing) < AGREE:
            return False
        self._agreeing.clear()
        return True

    def _close(self, one: Pose, other: Pose) -> bool:
        points = self._coordinates(np.array([one, other]))
        return bool(np.linalg.norm(points[0] - points[1]) <= 2.0 * self.place_m)

    def _answer(self, frame: Frame, error: float, ratio: float) -> Localisation:
        if self._belief is not None:
            pose, experience, confidence, since_m = self._belief
            left = 1.0 - (self._path_m - since_m) / (_COAST * self.place_m)
            if left < 1.0:  # odometry alone since the last evidence
                _, nearest = self._tree.query(self._coordinates(np.array(pose)))
                experience, confidence = int(self._own[nearest]), confidence * left
            if left > 0.0:
                return Localisation(
                    frame.index, frame.time_s, pose, experience, confidence, error, ratio
                )
            self._belief = None
        return Localisation(frame.index, frame.time_s, None, NO_EXPERIENCE, 0.0, error, ratio)
