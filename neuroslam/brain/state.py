"""State of a brain: modules, populations, sessions, and stored maps."""

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Self, SupportsIndex

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.brain.compass import Compass
from neuroslam.brain.continuity import Continuity
from neuroslam.brain.recognition import Recognition, StoredViews
from neuroslam.brain.stored_sequence import StoredSequence
from neuroslam.brain.tracker import SequenceTracker
from neuroslam.config import BrainConfig
from neuroslam.config.populations import HOMES
from neuroslam.config.size import check_size
from neuroslam.errors import ConfigError, counted
from neuroslam.geometry import compose
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import n_places
from neuroslam.merging.consistency import count_views
from neuroslam.merging.limits import WINDOW, elsewhere, tolerance
from neuroslam.merging.mapped import counts_of, differing
from neuroslam.merging.match import shared_history
from neuroslam.merging.merge import merge
from neuroslam.merging.report import MergeReport
from neuroslam.odometry import FlowOdometry, VisualOdometry, visual_odometry
from neuroslam.odometry.climb import VisualClimb
from neuroslam.state.answers import check_names
from neuroslam.state.match import Match
from neuroslam.state.mergeable import AboutNow, Mergeable, ModulesOf, QuickModule, State
from neuroslam.state.pickling import Calls, as_arrays, as_tensors
from neuroslam.state.population import Population
from neuroslam.state.registry import check_forgetting, leading_class, population_classes
from neuroslam.state.sessions import Session, SessionLog, session_id
from neuroslam.state.tables import Scalars
from neuroslam.threads import limit_threads, usable_threads
from neuroslam.types import NO_TEMPLATE, Frame, Pose, ViewMatch
from neuroslam.view.features import Encoder, view_encoder
from neuroslam.view.templates import LocalViewCells

if TYPE_CHECKING:
    from neuroslam.cells.clones import CloneCells
    from neuroslam.cells.head_direction import HeadDirectionCells
    from neuroslam.cells.navigation import NavigationCells
    from neuroslam.cells.pose import PoseCellNetwork
    from neuroslam.cells.pose_3d import PoseCells3D
    from neuroslam.cells.speed import SpeedCells
    from neuroslam.spiking.semantic import SemanticCells


class Clock(Scalars, AboutNow):
    """Present frame and time."""

    frame: int
    time_s: float
    frames_seen: int


class BrainState(QuickModule):
    """State of a brain, its merging and its stored maps; a subclass processes frames.

    Args:
        config: All parameters.
        features: Network that computes views, if ``config.view.features`` is ``"module"``.

    Raises:
        ConfigError: If the config asks for more memory than there is.

    Attributes:
        half_taken: Why the state is not that of any frame: an error interrupted a frame after the
            state had begun to change. The brain then takes no frame and cannot be saved, stored or
            merged, until a state is loaded; empty: the state is sound.
    """

    half_taken: str
    clock: Clock
    odometry: VisualOdometry | FlowOdometry
    climb: VisualClimb | None
    view: LocalViewCells
    map: ExperienceMap
    # Populations of the package, if config.cells names them:
    pose_cells: "PoseCellNetwork"
    navigation: "NavigationCells"
    semantic: "SemanticCells"
    head_direction: "HeadDirectionCells"
    speed: "SpeedCells"
    pose_3d: "PoseCells3D"
    clones: "CloneCells"
    compass: Compass
    sessions: SessionLog
    recognition: Recognition
    continuity: Continuity
    stored: "ModulesOf[Self]"

    def __init__(
        self, config: BrainConfig | None = None, *, features: nn.Module | Encoder | None = None
    ) -> None:
        super().__init__()
        self.config = config or BrainConfig()
        check_size(self.config)
        check_forgetting(self.config)
        self._encoder = view_encoder(self.config.view, features)
        # Source, preset and date of the next session.
        self.about: tuple[str, str, str] = ("", "", "")
        self._detects = self.config.sessions.kidnapped == "detect"
        self._after_gap_s = -math.inf  # time of a frame that was refused after a gap
        self.half_taken = ""
        self.clock = Clock(frame=-1, time_s=0.0, frames_seen=0)
        self.stored = ModulesOf()
        self._begin()
        self.register_load_state_dict_pre_hook(_make_stored)
        self.register_load_state_dict_post_hook(Calls("_loaded"))
        self.register_state_dict_pre_hook(_refuse_half_taken)
        # Attributes that a pickle does not keep; a subclass may have more.
        self._own = frozenset((*self.__dict__, *self._modules, "_own"))

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        """Return how a pickle rebuilds the brain: from its config, its network and its state.

        Raises:
            RuntimeError: If the state is not that of any frame, see :attr:`half_taken`.
        """
        attributes = self.__dict__ | self._modules  # parts that were found are in both
        more = {name: value for name, value in attributes.items() if name not in self._own}
        others = tuple(f"{name}." for name in more)
        state = {
            name: array
            for name, array in as_arrays(self.state_dict()).items()
            if not name.startswith(others)
        }
        more |= {name: self.__dict__[name] for name in ("about", "training", "_after_gap_s")}
        device = str(self.map.experiences["pose"].device)
        return _rebuilt, (type(self), self.config, self._encoder, state, more, device)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move all tensors, as ``.to(device)`` does; they keep their types.

        Raises:
            TypeError: If a type would change: a brain goes on bit for bit only in its own.
        """
        for dtype in (torch.float32, torch.float64):
            to = fn(torch.empty(0, dtype=dtype)).dtype
            if to != dtype:
                raise TypeError(
                    f"{type(self).__name__}: cannot be converted from {dtype} to {to}: its "
                    "activity is float32, its positions and times are float64; use .to(device) "
                    "alone"
                )
        return super()._apply(fn, recurse)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return a copy with all parts and attributes, which shares no memory with this brain."""
        copied = type(self).__new__(type(self))
        memo[id(self)] = copied
        copied.__dict__.update(deepcopy(self.__dict__, memo))
        return copied

    def _begin(self) -> None:
        """Start with an empty map."""
        config, cells = self.config, self.config.pose_cells
        self.odometry = visual_odometry(config.odometry, config.view.grey)
        seen = config.odometry.climb != "given"
        self.climb = VisualClimb(config.odometry, config.view.grey) if seen else None
        self.view = LocalViewCells(config.view, self._encoder)
        self.map = ExperienceMap(
            config.map, (cells.n_xy, cells.n_xy, cells.n_theta), cells.create_threshold_cells
        )
        leader = leading_class(config)
        for population in population_classes(config):
            setattr(self, population.name, population.build(config, leader))
        self.compass = Compass()
        self.sessions = SessionLog()
        self.recognition = Recognition()
        self.continuity = Continuity(config)
        self.tracker: SequenceTracker | None = None
        votes = any(_overrides(cls, "weigh") for cls in population_classes(config))
        follows = config.map.closure == "sequence" or votes
        if follows and leader.relaxes_map and leader.needs_views:
            self.tracker = SequenceTracker(config.sequence)
            self.recognition.sequence = StoredSequence(config.sequence)
        self._changed()
        if set(self._populations) - HOMES.keys():  # those of the package have names of their own
            check_names(self._populations.values())

    def _loaded(self) -> None:
        """Go on from a whole state.

        Raises:
            ValueError: If it has seen less than no frames.
        """
        if self.clock.frames_seen < 0 or self.clock.frame < -1:
            raise ValueError(
                f"clock: {self.clock.frames_seen} frames seen, the last is frame "
                f"{self.clock.frame}; expected 0 or more, and -1 or more"
            )
        self.half_taken = ""
        self._changed()

    def _changed(self) -> None:
        """Update what is derived from populations and stored maps."""
        self._stored_views: StoredViews | None = None
        classes = population_classes(self.config)
        self._populations: dict[str, Population] = {
            cls.kind: getattr(self, cls.name) for cls in classes
        }
        leader = leading_class(self.config)
        self._leads = leader.kind
        # Only overridden hooks are called.
        self._with = {
            hook: [p for p in self._populations.values() if _overrides(type(p), hook)]
            for hook in (
                "observe",
                "check",
                "inform",
                "step",
                "vetoes",
                "excludes",
                "follow",
                "learn",
                "recall",
                "weigh",
            )
        }
        self._makes_views = any(cls.needs_views for cls in classes)
        uses = {cls.compass for cls in classes}
        self._has_compass = bool(uses - {"ignores"})
        self._compass_turns_map = (
            leader.relaxes_map and self._has_compass and "corrects" not in uses
        )

    @property
    def populations(self) -> dict[str, Population]:
        """The populations by kind, in the order of their steps."""
        return self._populations

    @property
    def leader(self) -> Population:
        """The population that decides about experiences."""
        return self._populations[self._leads]

    def parts(self) -> dict[str, Mergeable]:
        """Return the parts of the state, by name."""
        return {name: p for name, p in self.named_children() if isinstance(p, Mergeable)}

    def merge(self, partial: Self, match: Match) -> tuple[Self | None, MergeReport]:
        """Merge the map of another session into this one; neither brain is altered.

        Args:
            partial: The brain whose session continues; its activity, time and odometry are kept.
            match: Match of the two maps, from :func:`~neuroslam.merging.match.find_match`.

        Returns:
            The merged brain, or ``None`` if the merge is refused, and the report.

        Raises:
            MapError: If the match names experiences that do not exist.
        """
        state, _, report = merge(self, partial, match)
        if state is None:
            return None, report
        merged = type(self)(partial.config)
        merged.restore(state, [*map(deepcopy, self.stored), *map(deepcopy, partial.stored)])
        merged.to(partial.map.experiences["pose"].device)
        counts = [counts_of(brain) for brain in (self, partial, merged)]
        report.counts |= {
            name: dict(zip(("loaded", "partial", "merged"), values, strict=True))
            for name, value in counts[2].items()
            if name not in report.counts and isinstance(value, int)
            for values in ([count[name] for count in counts],)
        }
        merged.sessions.merges.append(report.to_dict())
        return merged, report

    def store(self, other: Self) -> None:
        """Store the maps of another brain; each is joined to this map once it is recognised.

        Args:
            other: The other brain, which is not altered; its own stored maps are stored too.

        Raises:
            ConfigError: If the configs of views or populations differ, or the networks of views.
        """
        self.view.load_network()
        apart = differing(self, other)
        if apart:
            raise ConfigError(
                f"the stored map has another config: {'; '.join(apart)}; "
                "run with the config of the stored map"
            )
        for one in (other, *other.stored):
            if one.map.n:
                self._store_one(one)
        if self.recognition.sequence is not None:
            self.recognition.sequence.forget()
        self._changed()

    def _store_one(self, one: Self) -> None:
        copy = type(self)(one.config)
        copy.restore(one.state_dict(), [])
        for i, before in enumerate(self.stored):
            shared = shared_history(before, copy)
            merged = before.merge(copy, shared.match)[0] if shared and shared.match else None
            if merged is not None:  # two continuations of one map
                self.stored[i] = merged
                return
        self.stored.append(copy)
        self.recognition.store()

    def start_new_map(self, why: str = "kidnapped") -> None:
        """Store the present map and continue with an empty one, as after a kidnapping.

        The stored map is joined again once it is recognised.

        Args:
            why: ``kidnapped`` or ``gap``; stored with the new session.
        """
        if not self.map.n:
            return
        before, tally = self.sessions.now, self.recognition.tally
        # Kept: they compare successive frames.
        senses = self.odometry, self.climb, self.continuity
        sequence = self.recognition.sequence
        kept = type(self)(self.config)
        kept.restore({k: v for k, v in self.state_dict().items() if k[:7] != "stored."}, [])
        self.stored.append(kept)
        populations = dict(self._populations)
        self._begin()
        for kind, population in self._populations.items():
            population.continue_from(populations[kind])
        self.odometry, self.climb, self.continuity = senses
        self.recognition.sequence = sequence
        for alike, agreed in zip(tally["alike"].tolist(), tally["agreed"].tolist(), strict=True):
            self.recognition.tally.append(alike=alike, agreed=agreed)
        self.recognition.store()
        self._continue_session(before, why)

    def _continue_session(self, before: Session, why: str) -> None:
        """Open a session of the same recording: odometry does not connect it with the last one."""
        session = Session(
            session_id(before.id, self.clock.frames_seen, why),
            before.source,
            before.preset,
            before.recorded,
            self.clock.frame + 1,
            self.clock.time_s,
            began=why,
            continues=before.id,
        )
        self._open(session)
        self.map.state.made = 0

    def restore(self, state: State, stored: Sequence[Self]) -> None:
        """Replace the state and the stored maps."""
        self._begin()
        self.stored = ModulesOf(stored)
        own = {name: value for name, value in state.items() if not name.startswith("stored.")}
        for i, one in enumerate(stored):
            own |= {f"stored.{i}.{name}": value for name, value in one.state_dict().items()}
        self.load_state_dict(own)
        if self.recognition.sequence is not None:
            self.recognition.sequence.forget()
        tally = self.recognition.tally
        rows = {name: tally[name][: len(stored)] for name in tally.columns}
        tally.replace(**rows)
        while tally.n < len(stored):
            tally.append(alike=0, agreed=0)

    def _open(self, session: Session) -> None:
        self.sessions.sessions.append(session)
        self.map.state.session = session.id

    def _recognise(self, frame: Frame, encoded: np.ndarray, view: ViewMatch) -> bool:
        """Join a stored map if enough recent experiences match it."""
        config, recognition = self.config.sessions, self.recognition
        if not len(self.stored):
            return False
        recognition.arrive(WINDOW * config.confirm)
        if self._recognise_sequence(frame, encoded, view):
            return True
        if not len(self.stored):
            return False
        where, seen = self._searched.search(encoded)
        if seen.template == NO_TEMPLATE:
            return False
        loaded = self.stored[where].map
        templates = loaded.experiences["template"].numpy()
        recognition.note(
            where,
            np.flatnonzero(templates == seen.template),
            self.map.current,
            seen.relative_heading_rad - view.relative_heading_rad,
            seen.error,
        )
        limits = tolerance((loaded, self.map), self.config)
        agreed = recognition.confirmed(where, loaded, self.map, limits)
        if n_places(agreed) < config.confirm:
            return False
        if config.check_residuals and count_views(loaded, self.map, agreed) < config.confirm:
            return False  # one view along the whole path tells nothing about the place
        near = templates[~elsewhere(loaded, int(agreed.loaded[-1]), limits)]
        match = Match(
            loaded=int(agreed.loaded[-1]),
            partial=self.map.current,
            turn_rad=float(agreed.turn_rad[-1]),
            error=seen.error,
            runner_up=self._searched.runner_up(encoded, where, near),
            others=agreed.pick(slice(-1)),
        )
        return self._join(where, match, frame)

    @property
    def _searched(self) -> StoredViews:
        """The stored maps as one memory."""
        if self._stored_views is None:
            self._stored_views = StoredViews(
                [one.view for one in self.stored], [one.map for one in self.stored]
            )
        return self._stored_views

    def _judge_stored(self, encoded: np.ndarray, change: float) -> bool:
        """Return whether the sequence of views shows a place of a stored map."""
        if self.recognition.sequence is None or not len(self.stored):
            return False
        stored = self._searched
        return self.recognition.sequence.judge(stored.compare(encoded)[0], stored.graph, change)

    def _recognise_sequence(self, frame: Frame, encoded: np.ndarray, view: ViewMatch) -> bool:
        """Join a stored map if the sequence of views shows a place of it, and track it there."""
        sequence, recognition = self.recognition.sequence, self.recognition
        if sequence is None or not sequence.believed:
            return False
        candidate, graph = sequence.state.candidate, self._searched.graph
        where, experience = graph.locate(candidate)
        turn_rad = float(self._searched.compare(encoded)[1][candidate]) - view.relative_heading_rad
        recognition.note(
            where, np.array([experience]), self.map.current, turn_rad, sequence.state.error
        )
        loaded = self.stored[where].map
        limits = tolerance((loaded, self.map), self.config)
        agreed = recognition.confirmed(where, loaded, self.map, limits)
        costs = sequence.evidence.array("cost")[graph.starts[where] : graph.starts[where + 1]]
        costs = costs.copy()
        match = Match(
            loaded=int(agreed.loaded[-1]),
            partial=self.map.current,
            turn_rad=float(agreed.turn_rad[-1]),
            error=float(agreed.error[-1]),
            others=agreed.pick(slice(-1)),
        )
        joined = self._join(where, match, frame)
        if joined and self.tracker is not None:
            self.tracker.track(costs)
        elif not joined:
            sequence.forget()
        return joined

    def _join(self, where: int, match: Match, frame: Frame) -> bool:
        """Join stored map ``where``, and then those that share a session with it."""
        rest = [one for i, one in enumerate(self.stored) if i != where]
        loaded, everything, tally = self.stored[where], self.stored, self.recognition.tally
        self.stored = ModulesOf()  # the other stored maps are not copied
        merged, report = loaded.merge(self, match)
        self.stored = everything
        report.at_frame = frame.index
        if merged is None:
            self.recognition.forget()
            self.sessions.refusals.append(report.to_dict())
            return False
        merged.sessions.merges[-1] = report.to_dict()
        for name, part in merged.parts().items():
            setattr(self, name, part)
        self.view.encoder = self._encoder
        self.stored = ModulesOf(rest)
        rows = zip(tally["alike"].tolist(), tally["agreed"].tolist(), strict=True)
        for i, (alike, agreed) in enumerate(rows):
            if i != where:
                self.recognition.tally.append(alike=alike, agreed=agreed)
        self._changed()
        for i, one in enumerate(rest):
            shared = shared_history(one, self)
            if shared is not None and shared.match is not None:
                self._join(i, shared.match, frame)
                break
        return True

    @property
    def largest(self) -> Self:
        """The largest map of this drive: the present one, or one that a kidnapping or gap ended.

        It is the one that is drawn and written; stored maps of other drives do not count.
        """
        maps = [self, *self.stored]
        before = {s.id: s.continues for one in maps for s in one.sessions.sessions}
        drive: set[int] = set()
        session = self.sessions.now.id if self.sessions.sessions else 0
        while session:
            drive.add(session)
            session = before.get(session, 0)
        ours = [one for one in maps if any(s.id in drive for s in one.sessions.sessions)]
        return max(ours, key=lambda one: one.map.n, default=self)

    def not_joined(self) -> list[dict[str, object]]:
        """Return for each map beside the largest how much was recognised, for a run's report."""
        tally, needed = self.recognition.tally, self.config.sessions.confirm
        largest = self.largest
        others = [self if one is largest else one for one in self.stored]
        return [
            {
                "sessions": [session.name for session in one.sessions.sessions],
                "experiences": one.map.n,
                "places_that_look_alike": alike,
                "places_that_agree": agreed,
                "reason": "maps without views are merged when they are finished: neuroslam merge"
                if not self._makes_views
                else f"{counted(alike, 'experience')} matched by view, at most {agreed} agreed on "
                f"the alignment; expected {needed}",
            }
            for one, alike, agreed in zip(
                others, tally["alike"].tolist(), tally["agreed"].tolist(), strict=True
            )
        ]

    @property
    def landmarks_m(self) -> np.ndarray | None:
        """Points that populations draw on the map, ``(n, 2)`` in metres; ``None``: no points."""
        points = [p.points_m() for p in self._populations.values()]
        known = [rows for rows in points if rows is not None]
        return np.concatenate(known) if known else None

    def place(self, experience: int, offset: Pose) -> Pose:
        """Return the pose on the present map of a robot at ``offset`` from an experience.

        Args:
            experience: Id, or -1 for the origin before the first experience.
            offset: Pose relative to that experience, the ``map.offset`` at that time.
        """
        if experience < 0:
            return offset
        return compose(Pose(*self.map.experiences["pose"][experience].tolist()), offset)


def _overrides(population: type[Population], hook: str) -> bool:
    return getattr(population, hook) is not getattr(Population, hook)


def _rebuilt(
    brain_class: type[BrainState],
    config: BrainConfig,
    encoder: Encoder,
    state: dict[str, np.ndarray],
    more: dict[str, Any],
    device: str,
) -> BrainState:
    """Make a brain of what a pickle holds."""
    brain = brain_class.__new__(brain_class)
    with limit_threads(usable_threads(config.threads)):
        BrainState.__init__(brain, config, features=encoder)
        brain.load_state_dict(as_tensors(state))
    for name, value in more.items():
        setattr(brain, name, value)
    return brain if device == "cpu" else brain.to(device)


def _refuse_half_taken(module: BrainState, *_unused: object) -> None:
    """Keep a state that is not that of any frame from being saved, stored or merged."""
    if module.half_taken:
        raise RuntimeError(module.half_taken)


def _make_stored(module: BrainState, state: State, prefix: str, *_unused: object) -> None:
    """Create as many stored maps as a state has."""
    inside = f"{prefix}stored."
    numbers = {int(key[len(inside) :].split(".")[0]) for key in state if key.startswith(inside)}
    if len(numbers) != len(module.stored):
        module.stored = ModulesOf(type(module)(module.config) for _ in numbers)
