"""Tracking on the robot's own map by sequences of views, and after a kidnapping."""

from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch

from neuroslam.config.sequence import SequenceConfig
from neuroslam.geometry import TWO_PI, rotate, wrap_angle
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.sequence import RANGE, UNKNOWN, advance_costs, relative_errors, within_links
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.population import Population
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, Motion, Pose, Revoked, Tracking

_APART = 6
"""Links within which two experiences count as the same part of the map."""

_AHEAD = 3
"""Links that the robot may pass in a frame."""

_BESIDE = (2.5, 0.8)
"""Distance, in median links, and heading, rad, up to which two experiences are the same place."""

_SUDDEN = 0.75
"""Change between two frames, as a share of the mean match error, that may be a kidnapping."""

_REACH = {True: (1.0, 0.0), False: (2.0, 12.0)}
"""Largest jump on the map that odometry and tracking explain, after a sudden change of view and
without one: a share of the way since the robot was localised last, and a number of links."""

_PROOF = 100
"""Frames of good evidence after which a loop closure counts as proved."""

_SETTLE = 20
"""Frames that evidence needs to show a kidnapping, beside those in doubt."""


class Mode(IntEnum):
    """What the tracker believes.

    Attributes:
        EXPLORES: The robot is at places that the map does not know.
        TRACKS: It is at a known experience.
        DOUBTS: The view changed abruptly: a bump, or a kidnapping.
        SEARCHES: It was kidnapped, and looks for itself on its map.
    """

    EXPLORES = 0
    TRACKS = 1
    DOUBTS = 2
    SEARCHES = 3


class _Around(Protocol):
    """Finds the experiences some links behind and ahead of one."""

    def __call__(self, experience: int, back: int, ahead: int) -> np.ndarray: ...


class Seen(NamedTuple):
    """Evidence of the last frame for a loop closure, as the tracker weighed it.

    Attributes:
        compared: Number of experiences that were compared.
        candidate: The one with most evidence, of the other parts of the map while one is tracked.
        evidence: Its lead over the mean, in standard deviations.
        rival: That of the best beside it.
        streak: Frames in a row that agreed on it.
        passed: Experiences that were passed meanwhile.
        alike: Match error with it, as a share of the usual one, averaged over these frames.
    """

    compared: int = 0
    candidate: int = NO_EXPERIENCE
    evidence: float = 0.0
    rival: float = 0.0
    streak: int = 0
    passed: int = 0
    alike: float = 1.0


class _State(Scalars):
    """What is remembered between frames.

    Attributes:
        mode: A :class:`Mode`.
        frames: Number of frames in which the robot moved.
        doubts: Frames since an abrupt change; at known places, as long as none fits them.
        streak: Frames in a row that agree on ``candidate``.
        candidate: Experience that the robot may be at.
        began: Where the candidates of the streak began.
        passed: Experiences that the candidates have passed since.
        bad: Frames in a row with too little evidence for the present experience.
        way_m: Path length since the robot was localised last.
        localised: 1 once it has been, else 0.
        since_sudden: Frames since the view changed much between two frames.
        alike: Match error with the candidates, as a share of the usual one, summed over the streak.
        origin: Experience at which a loop closure that is not proved yet begins, or none.
        joined: Experience at which it ends.
        proved: Frames of good evidence for it.
        dx_m: Displacement of the robot by odometry from ``origin``, in its frame.
        dy_m: And to the left.
        turn_rad: And its turn.
        jumped: Experience that the robot may have been moved to.
        jump_frames: Frames in a row that agree on it.
    """

    mode: int
    frames: int
    doubts: int
    streak: int
    candidate: int
    began: int
    passed: int
    bad: int
    way_m: float
    localised: int
    since_sudden: int
    alike: float
    origin: int
    joined: int
    proved: int
    dx_m: float
    dy_m: float
    turn_rad: float
    jumped: int
    jump_frames: int


class SequenceTracker(Mergeable):
    """Decides from sequences of views where on its own map the robot is.

    :mod:`neuroslam.mapping.sequence` has the recursion. A loop closure is believed if its evidence
    exceeds ``believe`` and leads over any other part of the map by ``margin``, in
    ``confirm_frames`` frames in a row that pass ``confirm_experiences`` experiences along the
    links. While the robot is at known places no experience is made, so that a map of repeated laps
    stops growing. After an abrupt change of view the robot is first looked for where it was, then
    on the whole map; only then has a new map to begin.

    Args:
        config: Limits of the evidence.
    """

    def __init__(self, config: SequenceConfig) -> None:
        super().__init__()
        self.config = config
        self.memory = 1.0 - 1.0 / config.memory_frames
        self.seen = Seen()
        self.voters: Sequence[Population] = ()
        self.closeness = np.empty(0)  # match errors of this frame, as a share of their mean
        self.new_view: float | None = None  # match error of a new view in this frame, where known
        # Of every experience: accumulated cost, and number of the frame that made it.
        # The fresh cost counts from the last sudden change of view on.
        self.evidence = GrowingTable(
            {name: ((), torch.float64) for name in ("cost", "fresh")} | {"made": ((), torch.int64)}
        )
        self.state = _State(
            mode=Mode.EXPLORES, frames=0, doubts=0, streak=0,
            candidate=NO_EXPERIENCE, began=NO_EXPERIENCE, passed=0, bad=0,
            way_m=0.0, localised=0, since_sudden=0,
            alike=0.0, origin=NO_EXPERIENCE, joined=NO_EXPERIENCE, proved=0,
            dx_m=0.0, dy_m=0.0, turn_rad=0.0,
            jumped=NO_EXPERIENCE, jump_frames=0,
        )  # fmt: skip

    @property
    def tracks(self) -> bool:
        """Whether the robot is at known places."""
        return self.state.mode == Mode.TRACKS

    def renumber(self, change: Renumbering) -> None:
        """Keep the evidence of the experiences that are kept."""
        rows = {
            name: change.rows_of_experiences(self.evidence[name]) for name in self.evidence.columns
        }
        self.evidence.replace(**rows)
        for name in ("candidate", "began", "jumped", "origin", "joined"):
            setattr(self.state, name, change.experience(getattr(self.state, name)))

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Forget the evidence, whose ids have changed; every experience is an old one."""
        n = join.n_experiences + len(join.kept_experiences)
        costs = partial["evidence.cost"].new_zeros(n)
        made = partial["evidence.made"].new_full((n,), -self.config.recent_frames)
        fresh = SequenceTracker(self.config).state_dict()
        merged: State = {name: v for name, v in fresh.items() if name.startswith("state.")}
        blank = {f"evidence.{name}": costs.clone() for name in ("cost", "fresh")}
        return merged | blank | {"evidence.made": made}

    @classmethod
    def faults(cls, state: Mapping[str, np.ndarray], n_experiences: int) -> Iterator[str]:
        """Yield what is invalid in a state, for a map of so many experiences."""
        rows = len(state["evidence.made"])
        if rows > n_experiences:
            yield f"tracker.evidence: {rows} rows for {n_experiences} experiences"
        if int(state["state.mode"]) not in set(Mode):
            yield f"tracker.state.mode: is {state['state.mode']}, expected 0 to {max(Mode)}"
        for name in ("candidate", "began", "jumped", "origin", "joined"):
            if not NO_EXPERIENCE <= int(state[f"state.{name}"]) < n_experiences:
                yield f"tracker.state.{name}: no experience {state[f'state.{name}']}"

    def track(self, costs: np.ndarray) -> None:
        """Go on at known places, with the evidence for a stored map that was joined.

        Args:
            costs: Accumulated costs of its experiences, the first ones of the map, ``(m,)``.
        """
        for name in ("cost", "fresh"):
            self.evidence.array(name)[: len(costs)] = costs
        self.state.mode, self.state.localised = Mode.TRACKS, 1

    def judge(
        self,
        errors: np.ndarray,
        map_: ExperienceMap,
        motion: Motion,
        change: float = 0.0,
        alarm: bool = False,
        voters: Sequence[Population] = (),
        excluded: np.ndarray | None = None,
    ) -> Tracking:
        """Take the match errors of a frame into the evidence, and say where the robot is.

        Args:
            errors: Match error with the view of every experience, ``(n,)``.
            map_: The robot's own map.
            motion: Since the last frame. A robot at rest adds no evidence; for the length of its
                path a full turn counts as a metre.
            change: Difference of the view from that of the last frame.
            alarm: Whether the view changed too abruptly for driving.
            voters: Who vote on loop closures, and propose some.
            excluded: Experiences that the robot cannot be at, whatever they look like, ``bool
                (n,)``: on another storey. They count in the usual match error alone.
        """
        s, c, current = self.state, self.config, map_.current
        self.voters = voters
        while self.evidence.n < map_.n:
            self.evidence.append(cost=0.0, fresh=0.0, made=s.frames)
        way_m = (abs(motion.v_m_s) + abs(motion.w_rad_s) / TWO_PI) * motion.dt_s
        s.way_m += way_m
        if s.origin != NO_EXPERIENCE:
            s.turn_rad = wrap_angle(s.turn_rad + motion.w_rad_s * motion.dt_s)
            dx, dy = rotate(motion.v_m_s * motion.dt_s, 0.0, s.turn_rad)
            s.dx_m, s.dy_m = s.dx_m + dx, s.dy_m + dy
        if alarm and s.mode == Mode.EXPLORES:
            s.mode, s.doubts = Mode.DOUBTS, 0
            self._forget()
        elif alarm and self.tracks:  # the next frames decide
            s.doubts = 1
        self.new_view, self.seen = None, Seen()
        if not map_.n:
            return Tracking("explore", current)
        if not (way_m or alarm):
            return Tracking("at" if self.tracks else "wait", current)
        s.frames += 1
        source, target = (map_.links_table.array(name) for name in ("source", "target"))
        doubting = s.mode >= Mode.DOUBTS
        old = self.evidence.array("made") <= s.frames - c.recent_frames
        compared = np.ones(map_.n, dtype=bool) if doubting else old
        self.seen = Seen(int(compared.sum()))
        if self.seen.compared < c.min_experiences:
            self._forget()
            s.mode = Mode.EXPLORES
            return Tracking("explore", current)
        usual = float(errors[compared].mean())
        self.new_view = c.new_view * usual
        s.since_sudden = 0 if change > _SUDDEN * usual else s.since_sudden + 1
        relative = relative_errors(errors, compared)
        if excluded is not None:
            compared, relative = compared & ~excluded, np.where(excluded, RANGE[1], relative)
        fresh = self.evidence.array("fresh")
        if not s.since_sudden:
            fresh[:] = 0.0
        memory = min(self.memory, s.since_sudden / (1.0 + s.since_sudden))
        fresh[:] = advance_costs(fresh, relative, source, target, memory)
        costs = advance_costs(self.evidence.array("cost"), relative, source, target, self.memory)
        self.evidence.array("cost")[:] = costs
        costs = np.where(compared, costs, UNKNOWN)
        self.closeness = errors / usual

        def around(experience: int, back: int, ahead: int) -> np.ndarray:
            return within_links(experience, back, ahead, source, target, map_.n)

        proposed = self._proposed(around, map_)
        if proposed is not None:
            return proposed
        if doubting:
            near = around(current, _APART, _APART + s.doubts)
            return self._doubt(costs, compared, near, around, map_)
        if self.tracks:
            if excluded is not None and excluded[around(current, 1, _AHEAD + 1)].all():
                s.origin = s.joined = NO_EXPERIENCE  # a ramp does not contradict a loop closure
                return self._leave(current)
            return self._track(costs, compared, around, map_)
        best = int(costs.argmin())
        rival = np.where(around(best, _APART, _APART) | _beside(best, map_), UNKNOWN, costs).min()
        jump = self._jumped(compared, around, map_)
        if jump != NO_EXPERIENCE:
            return self._go(self._closing(jump, map_), jump, costs[jump], rival)
        if self._confirmed(best, costs[best], rival, around):
            kind = self._closing(best, map_)
            s.mode = Mode.TRACKS
            if kind == "link":
                self._begin_proof(best, map_)
            return self._go(kind, best, costs[best], rival)
        return Tracking("explore", current, -costs[best], -rival)

    def _begin_proof(self, joined: int, map_: ExperienceMap) -> None:
        """Remember where a loop closure begins, to revoke it if later frames contradict it."""
        s = self.state
        s.origin, s.joined, s.proved = map_.current, joined, 0
        s.dx_m, s.dy_m, s.turn_rad = map_.offset

    def _supported(self, experience: int) -> bool:
        """Return whether all voters support that the robot is at an experience."""
        return all(voter.supports(experience) for voter in self.voters)

    def _proposed(self, around: _Around, map_: ExperienceMap) -> Tracking | None:
        """Go where a voter is sure that the robot is, unless it is there already."""
        s, current = self.state, map_.current
        for voter in self.voters:
            there = voter.proposes()
            if there is None or not self._supported(there):
                continue
            if there == NO_EXPERIENCE:
                if s.mode != Mode.TRACKS:
                    continue
                s.mode, s.bad, s.doubts = Mode.EXPLORES, 0, 0
                return Tracking("leave", current)._replace(revoked=self._revoke())
            here = current != NO_EXPERIENCE and (
                around(current, _APART, _APART)[there] or _beside(current, map_)[there]
            )
            if here and s.mode != Mode.EXPLORES:
                continue
            self.evidence.array("cost")[:] = self.evidence.array("fresh")
            explored, driven = s.mode == Mode.EXPLORES, voter.reaches(there)
            s.mode = Mode.TRACKS
            if driven and explored:
                self._begin_proof(there, map_)
            if driven:
                return self._go("link" if explored else "at", there, 0.0, 0.0)
            s.origin = s.joined = NO_EXPERIENCE
            return self._go("set", there, 0.0, 0.0)
        return None

    def _track(
        self,
        costs: np.ndarray,
        compared: np.ndarray,
        around: _Around,
        map_: ExperienceMap,
    ) -> Tracking:
        """Follow the robot along the links, and notice when it left them."""
        s, c, current = self.state, self.config, map_.current
        near = np.flatnonzero(around(current, 1, _AHEAD + 1 + s.bad))
        here = int(near[costs[near].argmin()])
        elsewhere = np.where(around(here, _APART, _APART), UNKNOWN, costs)
        best = int(elsewhere.argmin())
        s.bad = s.bad + 1 if costs[here] > -c.keep else 0
        if here != current and not self._supported(here):
            here = current  # it looks like a place farther on, but odometry contradicts
        if not s.bad and costs[here] <= elsewhere[best]:
            s.way_m, s.proved = 0.0, s.proved + 1
            if s.proved >= _PROOF:
                s.origin = NO_EXPERIENCE
        if self._confirmed(best, elsewhere[best], costs[here], around):
            driven = int(s.way_m / max(_link_length(map_), 1e-9))
            if around(current, 0, min(2 * driven + _APART, map_.n // 3))[best]:
                return self._go("at", best, elsewhere[best], costs[here])  # it lagged behind
            return self._correct(best, elsewhere[best], costs[here], map_)
        jump = self._jumped(compared, around, map_)
        if jump != NO_EXPERIENCE:
            return self._correct(jump, elsewhere[best], costs[here], map_)
        if self._kidnapped(around, current):
            s.mode, s.bad, s.doubts = Mode.SEARCHES, 0, c.doubt_frames
            self.evidence.array("cost")[:] = self.evidence.array("fresh")
            return Tracking("wait", current, -costs[here], -elsewhere[best])
        if s.bad >= c.lost_frames and not self._supported(NO_EXPERIENCE):
            return Tracking("wait", current, -costs[here], -elsewhere[best])
        if s.bad >= c.lost_frames:
            return self._leave(current, costs[here], elsewhere[best])
        return Tracking("at", current if s.bad else here, -costs[here], -elsewhere[best])

    def _leave(self, current: int, cost: float = 0.0, rival: float = 0.0) -> Tracking:
        """Explore from where the known places end."""
        s = self.state
        s.mode, s.bad, s.doubts = Mode.EXPLORES, 0, 0
        left = Tracking("leave", current, -float(cost), -float(rival))
        return left._replace(revoked=self._revoke())

    def _doubt(
        self,
        costs: np.ndarray,
        compared: np.ndarray,
        near: np.ndarray,
        around: _Around,
        map_: ExperienceMap,
    ) -> Tracking:
        """Look for the robot where it was, then on the whole map."""
        s, c, current = self.state, self.config, map_.current
        s.doubts += 1
        s.bad = s.bad + 1 if self.closeness[near].min() < c.alike else 0
        if s.bad >= 3:  # frames in a row that show where the robot was
            return self._resume(current)
        best = int(costs.argmin())
        rival = np.where(around(best, _APART, _APART) | _beside(best, map_), UNKNOWN, costs).min()
        if self._confirmed(best, costs[best], rival, around):
            if around(current, _APART, _APART + s.doubts)[best]:
                return self._resume(current)
            s.mode = Mode.TRACKS
            return self._go("set", best, costs[best], rival)
        if s.mode == Mode.SEARCHES:
            jump = self._jumped(compared, around, map_)
            if jump != NO_EXPERIENCE:
                return self._go(self._closing(jump, map_), jump, costs[jump], rival)
        if s.doubts > c.doubt_frames:
            s.mode = Mode.SEARCHES
        if s.doubts > c.doubt_frames + c.search_frames:
            return Tracking("kidnapped", current)
        return Tracking("wait", current, -costs[best], -rival)

    def _confirmed(self, best: int, cost: float, rival: float, around: _Around) -> bool:
        """Count frames in a row that agree, along the links, on where the robot is."""
        s, c = self.state, self.config
        seen = self.seen._replace(candidate=best, evidence=-float(cost), rival=-float(rival))
        if not (cost < -c.believe and cost < rival - c.margin):
            s.streak, s.candidate, self.seen = 0, NO_EXPERIENCE, seen
            return False
        if s.candidate == NO_EXPERIENCE or not around(s.candidate, 1, _AHEAD)[best]:
            s.streak, s.passed, s.began, s.alike = 0, 0, best, 0.0
        elif best not in (s.candidate, s.began):
            s.passed += 1
        s.streak, s.candidate = s.streak + 1, best
        s.alike += float(self.closeness[best])
        alike = s.alike / s.streak
        self.seen = seen._replace(streak=s.streak, passed=s.passed, alike=alike)
        enough = s.streak >= c.confirm_frames and s.passed >= c.confirm_experiences
        return enough and alike <= c.alike and self._supported(best)

    def _jumped(self, compared: np.ndarray, around: _Around, map_: ExperienceMap) -> int:
        """Return where the robot is after a sudden change of view, or that there is no sign of one.

        Frames since the change fit a path elsewhere, and none near the present experience.
        """
        s, c = self.state, self.config
        if not s.localised or not _SETTLE // 2 <= s.since_sudden <= 3 * _SETTLE:
            s.jumped, s.jump_frames = NO_EXPERIENCE, 0
            return NO_EXPERIENCE
        fresh = np.where(compared, self.evidence.array("fresh"), UNKNOWN)
        best = int(fresh.argmin())
        near = around(map_.current, _APART, _APART + s.since_sudden // 2)
        known = 3.0 * c.margin if self.tracks and self._fits(near) else c.margin
        rival = np.where(around(best, _APART, _APART) | _beside(best, map_), UNKNOWN, fresh).min()
        lead = min(fresh[near].min() - known, rival - c.margin) - fresh[best]
        if near[best] or fresh[best] > -c.believe or lead < 0.0 or not self._fits(best):
            s.jumped, s.jump_frames = NO_EXPERIENCE, 0
            return NO_EXPERIENCE
        follows = s.jumped != NO_EXPERIENCE and around(s.jumped, 1, _AHEAD)[best]
        s.jumped, s.jump_frames = best, (s.jump_frames + 1 if follows else 0)
        if s.jump_frames < c.confirm_frames // 3 or not self._supported(best):
            return NO_EXPERIENCE
        s.mode = Mode.TRACKS
        self.evidence.array("cost")[:] = self.evidence.array("fresh")
        return best

    def _kidnapped(self, around: _Around, current: int) -> bool:
        """Return whether no frame since an abrupt change fits the places where the robot was."""
        s = self.state
        if s.doubts:
            near = around(current, _APART, _APART + s.doubts // 2)
            s.doubts = 0 if self._fits(near) else s.doubts + 1
        return s.doubts > _SETTLE

    def _fits(self, some: np.ndarray | int) -> bool:
        """Return whether a frame is like one of some experiences, if not as like as a closure."""
        return bool(self.closeness[some].min() <= 0.5 * (1.0 + self.config.alike))

    def _correct(self, best: int, cost: float, rival: float, map_: ExperienceMap) -> Tracking:
        """Go to another part of the map; a loop closure that led astray is revoked."""
        revoked = self._revoke()
        if revoked is None:
            return self._go(self._closing(best, map_), best, cost, rival)
        kind = "link" if all(voter.reaches(best) for voter in self.voters) else "set"
        return self._go(kind, best, cost, rival)._replace(revoked=revoked)

    def _revoke(self) -> Revoked | None:
        """Return the loop closure that is not proved, to be undone."""
        s = self.state
        if s.origin == NO_EXPERIENCE:
            return None
        revoked = Revoked(s.origin, s.joined, Pose(s.dx_m, s.dy_m, s.turn_rad))
        s.origin = s.joined = NO_EXPERIENCE
        return revoked

    def _closing(self, best: int, map_: ExperienceMap) -> Literal["link", "set"]:
        """Return whether the robot can have driven to an experience since it was localised last."""
        pose = map_.pose
        apart = float(np.hypot(*(map_.pose_table[best, :2] - (pose.x_m, pose.y_m))))
        share, links = _REACH[self.state.since_sudden <= self.config.doubt_frames + _SETTLE]
        reach = share * self.state.way_m + links * _link_length(map_)
        self.state.since_sudden = 4 * _SETTLE  # the change is explained
        driven = apart <= reach or not self.state.localised
        return "link" if driven and all(v.reaches(best) for v in self.voters) else "set"

    def _go(
        self, kind: Literal["at", "link", "set"], experience: int, cost: float, rival: float
    ) -> Tracking:
        s = self.state
        s.bad = s.streak = s.doubts = s.jump_frames = 0
        s.way_m, s.localised = 0.0, 1
        s.candidate = NO_EXPERIENCE
        return Tracking(kind, experience, -float(cost), -float(rival))

    def _resume(self, current: int) -> Tracking:
        """Go on as before the doubt: at a known place, or exploring from a new one."""
        s = self.state
        known = self.evidence.array("made")[current] <= s.frames - self.config.recent_frames
        s.mode, s.doubts = (Mode.TRACKS if known else Mode.EXPLORES), 0
        self._forget()
        return Tracking("at" if known else "explore", current)

    def _forget(self) -> None:
        s = self.state
        self.evidence.array("cost")[:] = 0.0
        s.streak, s.candidate, s.bad = 0, NO_EXPERIENCE, 0


def _beside(experience: int, map_: ExperienceMap) -> np.ndarray:
    """Return which experiences lie beside one and have its heading: the same place, mapped again.

    The links do not join them to it where the robot left its map for a while.
    """
    apart = map_.pose_table - map_.pose_table[experience]
    close = np.hypot(apart[:, 0], apart[:, 1]) <= _BESIDE[0] * _link_length(map_)
    return np.asarray(close & (np.cos(apart[:, 2]) >= np.cos(_BESIDE[1])))


def _link_length(map_: ExperienceMap) -> float:
    """Return the median length of the links, metres."""
    lengths = map_.links_table.array("distance_m")
    return float(np.median(lengths)) if len(lengths) else 0.0
