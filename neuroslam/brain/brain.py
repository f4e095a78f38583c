"""The brain: odometry, views, a map and populations of cells, advanced frame by frame."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain.forgetting import forget
from neuroslam.brain.state import BrainState
from neuroslam.errors import BadFrame, SourceError, first_line
from neuroslam.odometry.climb import Outlook
from neuroslam.odometry.flow import FlowOdometry, Picture, Reckoned
from neuroslam.odometry.visual import Profiles
from neuroslam.sensors.frames import (
    check_image,
    check_instant,
    checked_number,
    checked_odometry,
)
from neuroslam.state.answers import moves_others
from neuroslam.state.population import Correction, Decision, Population, StepInput, total
from neuroslam.state.sessions import Session, session_id
from neuroslam.threads import is_plain, limit_threads, usable_threads, without_autocast
from neuroslam.types import (
    NO_EXPERIENCE,
    NO_TEMPLATE,
    Frame,
    Motion,
    PoseEstimate,
    StepResult,
    Tracking,
    Velocity,
    ViewMatch,
)

BLIND = ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)


class Accepted(NamedTuple):
    """A checked frame and the observations in it; the state has not changed yet.

    Attributes:
        frame: As the source delivered it.
        view: Its encoded view; ``None``: no image, or one without contrast.
        observed: Observation of each population, by kind.
        velocity: Self-motion, measured or from visual odometry.
        dt_s: Time since the last frame.
        profiles: What the visual odometry of the next frame needs; ``None``: not used.
        gap: The time since the last frame exceeds ``max_gap_s``: a new map begins.
        v_z_m_s: Speed upwards, measured or seen.
        outlook: What the next image needs to see it; ``None``: it is not seen.
    """

    frame: Frame
    view: np.ndarray | None
    observed: dict[str, Any]
    velocity: Velocity
    dt_s: float
    profiles: Profiles | Picture | Reckoned | None
    gap: bool
    v_z_m_s: float = 0.0
    outlook: Outlook | None = None


class NavigationBrain(BrainState):
    """Maps a stream of frames with any set of populations.

    ``odometry``, ``view`` and ``map`` are modules that can be used alone, and so are the
    populations named in ``config.cells``, each an attribute: ``pose_cells`` (RatSLAM),
    ``navigation`` (SLRB), ``semantic`` (SSP-SLAM), ``head_direction``, ``speed`` or your own. One
    of them leads: it decides about experiences. Every population estimates the pose from
    self-motion and its own senses, corrects it from memory, and receives the corrections of the
    others; see :mod:`neuroslam.state.population`. ``state_dict`` holds the complete state: a brain
    that was saved and loaded continues bit for bit like one that never stopped.

    Args:
        config: All parameters; the defaults suit a forward camera on a small robot.
        features: Network that computes views, if ``config.view.features`` is ``"module"``; see
            :class:`~neuroslam.view.features.FeatureEncoder`.

    Example:
        >>> from neuroslam.config import BrainConfig
        >>> from neuroslam.types import Frame, Velocity
        >>> brain = NavigationBrain(BrainConfig())
        >>> picture = torch.arange(160 * 120).reshape(120, 160).to(torch.uint8).numpy()
        >>> brain(Frame(0, 0.0, picture, Velocity(0.5, 0.0))).action
        'create'
    """

    if TYPE_CHECKING:

        def __call__(self, frame: Frame) -> StepResult:
            """Advance by one frame, as :meth:`forward` does."""
            ...

    @torch.inference_mode()
    def forward(self, frame: Frame) -> StepResult:
        """Advance by one frame, on ``config.threads`` CPU threads and without autocast.

        Raises:
            BadFrame: If the time does not increase, the data is invalid, or there is neither
                odometry nor an image. The state is unchanged, and another frame can follow; after
                a gap, the second frame is accepted.
            MapError: If the robot would leave the space of a population; the state is unchanged.
            RuntimeError: If a population refuses a frame elsewhere than in ``observe`` or
                ``check``; or if an error interrupted an earlier frame, see ``half_taken``.
        """
        if self.half_taken:
            raise RuntimeError(self.half_taken)
        threads = usable_threads(self.config.threads)
        if is_plain(threads):
            return self._take(frame)
        with limit_threads(threads), without_autocast():
            return self._take(frame)

    def _take(self, frame: Frame) -> StepResult:
        """Check a frame and advance by it."""
        accepted = self._accept(frame)
        try:
            return self._advance(accepted)
        except BaseException as error:  # Ctrl-C too leaves some parts a frame ahead of others
            hook = _hook_in(error, self._populations.values())
            self.half_taken = (
                f"frame {frame.index} is half taken: {hook or 'its step'} was interrupted by "
                f"{type(error).__name__}; restore a state saved before it"
            )
            if isinstance(error, SourceError):  # else a caller would skip the frame and go on
                raise RuntimeError(
                    f"frame {frame.index}: {hook or 'the brain'} raised {type(error).__name__} "
                    f"({first_line(error)}) after the state had changed; refuse a frame in observe "
                    "or check"
                ) from error
            raise

    def _advance(self, accepted: Accepted) -> StepResult:
        """Advance by a checked frame."""
        now = self._enter(accepted)
        observed, leader = accepted.observed, self.leader
        informed, first = now, {}
        for population in self._with["inform"]:
            first[population.kind] = population.step(now, observed[population.kind])
            informed = population.inform(informed)
        made: list[tuple[Population | None, Correction | None]] = [
            (p, first[p.kind] if p.kind in first else p.step(informed, observed[p.kind]))
            for p in self._with["step"]
        ]
        if self._compass_turns_map:
            made.append((None, self.compass.step(now.compass_rad, now.motion)))
        decision: Decision | None = None
        cells: Any = None  # until the leader has decided
        if leader.relaxes_map:
            if any(p.vetoes(now.view) for p in self._with["vetoes"]):
                now = now._replace(vetoed=True)
            decision, cells = leader.decide(self.map, now), leader.estimate
        self._exchange(made)
        for population in self._with["learn"]:
            population.learn(now, observed[population.kind])
        for population in self._with["recall"]:
            belief = None if population is leader else leader.belief(self.map)
            correction = population.recall(now, observed[population.kind], belief)
            self._exchange([(population, correction)])
        if decision is None:
            decision, cells = leader.decide(self.map, now), leader.estimate
        return self._finish(accepted, now, decision, cells)

    def _accept(self, frame: Frame) -> Accepted:
        """Check a frame and compute its observations; every refusal happens here."""
        try:
            dt_s = self._elapsed(frame)
            observed = dict.fromkeys(self._populations)
            if self._has_compass and frame.heading_rad is not None:
                checked_number(frame.heading_rad, "heading", "rad")
            if frame.image is not None:
                check_image(frame.image)
            if frame.v_z_m_s is not None:
                checked_number(frame.v_z_m_s, "vertical speed", "m/s")
            for population in self._with["observe"]:
                observed[population.kind] = population.observe(frame)
            view = None
            if self._makes_views and frame.image is not None:
                view = self.view.usable_view(frame.image)
            velocity, profiles = self._velocity(frame, dt_s)
            v_z_m_s, outlook = self._speed_upwards(frame, velocity, dt_s)
            gap = dt_s > self.config.max_gap_s
            if not gap and self._with["check"]:  # after a gap a new map begins
                self._check(frame, observed, Motion(*velocity, dt_s))
        except BadFrame as fault:
            raise BadFrame(f"frame {frame.index}: {fault}") from None
        return Accepted(frame, view, observed, velocity, dt_s, profiles, gap, v_z_m_s, outlook)

    def _check(self, frame: Frame, observed: dict[str, Any], motion: Motion) -> None:
        now, leader = StepInput(frame.index, motion, BLIND, frame.heading_rad), self.leader
        for population in self._with["check"]:
            belief = None if population is leader else leader.belief(self.map)
            population.check(now, observed[population.kind], belief)

    def _enter(self, accepted: Accepted) -> StepInput:
        """Begin a frame: start a new map after a gap or a kidnapping, and match the view."""
        frame, view, velocity, dt_s = accepted[0], accepted.view, accepted.velocity, accepted.dt_s
        if accepted.profiles is not None:
            self.odometry.remember(accepted.profiles)  # type: ignore[arg-type]
        gap, climb, outlook = accepted.gap, accepted.v_z_m_s, accepted.outlook
        change, broken = (0.0, False) if view is None else self.continuity.compare(view)
        alarm = broken and self._detects
        if gap or alarm:
            if gap or self.tracker is None:
                self.start_new_map("gap" if gap else "kidnapped")
            if gap or accepted.profiles is not None:
                velocity = Velocity(0.0, 0.0)  # images of two places do not measure motion
            climb = 0.0 if gap or outlook is not None else climb
            dt_s = 1.0 / self.config.frame_rate_hz if gap else dt_s
        if self.climb is not None:
            self.climb.remember(outlook, accepted.dt_s, broken=gap or alarm)
        self.continuity.moved(velocity, dt_s)
        match, tracking = BLIND, None
        if view is not None and self.tracker is None:
            match = self.view.match_or_learn(view, self._hidden())
        elif view is not None:
            match, tracking = self._track(view, Motion(*velocity, dt_s), change, alarm)
        if not self.sessions.sessions:
            self._name_session(frame, accepted.observed)
        motion = Motion(*velocity, dt_s)
        return StepInput(
            frame.index, motion, match, frame.heading_rad, tracking=tracking, v_z_m_s=climb
        )

    def _excluded(self) -> np.ndarray | None:
        """Return at which experiences the robot cannot be, ``bool (n,)``; ``None``: at any."""
        masks = [mask for p in self._with["excludes"] if (mask := p.excludes()) is not None]
        excluded = np.logical_or.reduce(masks) if masks else np.zeros(1, dtype=bool)
        return excluded if excluded.any() else None

    def _hidden(self) -> np.ndarray | None:
        """Return which templates cannot match, ``bool (n,)``: those of excluded experiences."""
        excluded = self._excluded()
        if excluded is None:
            return None
        templates = self.map.experiences.array("template")
        hidden = np.zeros(self.view.n + 1, dtype=bool)  # the last: of experiences without a view
        hidden[templates[excluded]] = True
        hidden[templates[~excluded]] = False
        return hidden[:-1]

    def _track(
        self, view: np.ndarray, motion: Motion, change: float, alarm: bool
    ) -> tuple[ViewMatch, Tracking]:
        """Localise the robot by the sequence of views; store a view of a place that is unknown."""
        assert self.tracker is not None
        templates = self.map.experiences.array("template")
        errors, headings = self.view.compare(view)
        of_experience = np.append(errors, 1.0)[templates]  # -1, without a view: the worst error
        voters = self._with["weigh"]
        for population in voters:
            population.weigh(of_experience, self.map, motion, self.tracker.tracks, alarm)
        found = self.tracker.judge(
            of_experience, self.map, motion, change, alarm, voters, self._excluded()
        )
        recalled = self._recall_stored(view, motion, change, alarm, found)
        if found.kind == "kidnapped" or (recalled and self._jumped(found)):
            self.start_new_map("kidnapped")
            return self.view.match_or_learn(view), Tracking("explore", self.map.current)
        if found.kind == "set":
            self._continue_session(self.sessions.now, "kidnapped")
        here = found.experience
        error = -1.0 if here == NO_EXPERIENCE else float(of_experience[here])
        limit = self.tracker.new_view or self.config.view.threshold
        unlike = not 0.0 <= error <= limit or any(p.splits(self.map) for p in voters)
        if found.kind == "leave" or (found.kind == "explore" and unlike):
            return ViewMatch(self.view.learn(view), error, 0.0, True), found
        if found.kind == "wait":
            return ViewMatch(NO_TEMPLATE, error, 0.0, False), found
        template = int(templates[here])
        heading = float(headings[template]) if template != NO_TEMPLATE else 0.0
        return ViewMatch(template, error, heading, False), found

    def _recall_stored(
        self, view: np.ndarray, motion: Motion, change: float, alarm: bool, found: Tracking
    ) -> bool:
        """Return whether the sequence of views shows a place of a stored map."""
        assert self.recognition.sequence is not None
        if not len(self.stored):
            return False
        known = found.kind in ("at", "link", "set")
        if alarm or known:
            self.recognition.sequence.forget()
        moves = motion.v_m_s != 0.0 or motion.w_rad_s != 0.0
        return not known and moves and self._judge_stored(view, change)

    def _jumped(self, found: Tracking) -> bool:
        """Return whether a sudden change of view began the sequence that a stored map explains.

        Then odometry does not connect the place with the present map.
        """
        assert self.recognition.sequence is not None
        return found.kind == "wait" or self.recognition.sequence.after_jump

    def _exchange(self, made: Sequence[tuple[Population | None, Correction | None]]) -> None:
        """Apply corrections to the map and to all populations but their authors."""
        some = [(author, c) for author, c in made if c is not None and moves_others(author, c)]
        if not some:
            return
        leader = self.leader
        if leader.relaxes_map:
            self.map.follow(total([c for _, c in some]))
        for follower in self._with["follow"]:
            others = [c for author, c in some if author is not follower]
            if others:
                both = total(others)
                follower.follow(both if follower is leader else both._replace(position_m=None))

    def _finish(
        self, accepted: Accepted, now: StepInput, decision: Decision, cells: PoseEstimate
    ) -> StepResult:
        """End a frame: count it, and join a stored map if enough experiences are recognised."""
        frame, view, (action, experience) = accepted.frame, now.view, decision
        self.clock.frame, self.clock.time_s = frame.index, float(frame.time_s)
        self.clock.frames_seen += 1
        self._after_gap_s = -math.inf
        self.sessions.now.frames += 1
        lost = any(population.lost for population in self._populations.values())
        encoded, arrived = accepted.view, action in ("create", "link")
        if arrived and encoded is not None and self._recognise(frame, encoded, view):
            view = view._replace(template=self.view.last.template, is_new=False)
            cells, action, experience = self.leader.estimate, "set", self.map.current
        if self.map.forgets and arrived and forget(self):
            experience, template = self.map.current, view.template
            if template != NO_TEMPLATE:
                template = int(self.map.experiences.array("template")[experience])
            view = view._replace(template=template)
        return StepResult(
            frame=frame.index,
            time_s=frame.time_s,
            motion=now.motion,
            view=view,
            action=action,
            experience=experience,
            pose=self.map.pose,
            cells=cells,
            n_templates=self.view.n,
            n_experiences=self.map.n,
            n_links=self.map.n_links,
            lost=lost,
        )

    def _name_session(self, frame: Frame, observed: dict[str, Any]) -> None:
        """Open a session; its id is a hash of config, source and first frame."""
        found: list[Any] = []
        for observation in observed.values():
            found += observation if isinstance(observation, tuple) else [observation]
        self._open(
            Session(
                session_id(
                    self.config.model_dump_json(),
                    self.about[0],
                    [session.id for one in self.stored for session in one.sessions.sessions],
                    frame.index,
                    float(frame.time_s),
                    frame.image,
                    frame.velocity,
                    frame.heading_rad,
                    *found,
                ),
                *self.about,
                frame.index,
                float(frame.time_s),
            )
        )

    def _elapsed(self, frame: Frame) -> float:
        check_instant(frame)
        if not self.clock.frames_seen:
            return 1.0 / self.config.frame_rate_hz
        dt_s = frame.time_s - self.clock.time_s
        begins = bool(self.sessions.sessions) and not self.sessions.now.frames
        if begins and not 0.0 < dt_s <= self.config.max_gap_s:
            return 1.0 / self.config.frame_rate_hz  # start_new_map: any time may have passed
        if not dt_s > 0.0:  # NaN too
            raise BadFrame(
                f"time {float(frame.time_s)} s does not follow {self.clock.time_s} s "
                f"of frame {self.clock.frame}; times must rise"
            )
        if dt_s > self.config.max_gap_s and self.config.sessions.after_gap == "new_map":
            return float(dt_s)
        if dt_s > self.config.max_gap_s:
            since_s = frame.time_s - self._after_gap_s
            if 0.0 < since_s <= self.config.max_gap_s:
                return float(since_s)  # the gap is real; the motion in it stays unknown
            self._after_gap_s = float(frame.time_s)
            raise BadFrame(
                f"{round(float(dt_s), 6)} s after frame {self.clock.frame}; expected at most "
                f"max_gap_s = {self.config.max_gap_s} s; raise it, or set sessions.after_gap = "
                "'new_map', if the gap is real"
            )
        return float(dt_s)

    def _speed_upwards(
        self, frame: Frame, velocity: Velocity, dt_s: float
    ) -> tuple[float, Outlook | None]:
        if self.climb is None:
            return (0.0 if frame.v_z_m_s is None else float(frame.v_z_m_s)), None
        if frame.image is None:
            return self.climb.reckon(velocity.v_m_s), None
        return self.climb.measure(frame.image, dt_s, *velocity)

    def _velocity(
        self, frame: Frame, dt_s: float
    ) -> tuple[Velocity, Profiles | Picture | Reckoned | None]:
        use = self.config.odometry.use
        if use == "fused" and isinstance(self.odometry, FlowOdometry):
            given = None if frame.velocity is None else checked_odometry(frame.velocity)
            gyroscope = frame.turn_rate_rad_s
            if gyroscope is not None:
                checked_number(gyroscope, "turn rate", "rad/s")
            if frame.image is not None:
                return self.odometry.measure(frame.image, dt_s, given, gyroscope)
            if given is not None:
                return self.odometry.reckon(dt_s, given, gyroscope)
        if use != "visual" and frame.velocity is not None:
            return checked_odometry(frame.velocity), None
        if use == "given" or frame.image is None:
            raise BadFrame(
                "no odometry in the source"
                + ("; set odometry.use to 'visual'" if use == "given" else " and no image")
            )
        return self.odometry.measure(frame.image, dt_s)


def _hook_in(error: BaseException, populations: Iterable[Population]) -> str:
    """Name the class and the method of a population in which an error was raised; else empty."""
    at, known = error.__traceback__, list(populations)
    while at is not None:
        code = at.tb_frame.f_code
        owner = at.tb_frame.f_locals.get(code.co_varnames[0]) if code.co_argcount else None
        if any(owner is population for population in known):
            return f"{type(owner).__name__}.{code.co_name}()"
        at = at.tb_next
    return ""
