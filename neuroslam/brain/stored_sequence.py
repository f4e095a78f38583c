"""Evidence of a sequence of views for a place in the stored maps, all of them together."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch

from neuroslam.config.sequence import SequenceConfig
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.sequence import UNKNOWN, advance_costs, relative_errors, within_links
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, NO_TEMPLATE

_APART = 6  # links within which two experiences are the same part of a map
_AHEAD = 3  # links that the robot may pass in a frame
_SUDDEN = 0.75  # change between two frames, as a share of the mean match error
_LONG = 1_000_000  # frames: no sudden change was seen
_BESIDE = 2.5, 0.8  # distance in median links, and heading in rad, up to which two are one place


class StoredGraph:
    """Experiences and links of several maps, numbered as one graph.

    Args:
        maps: At least one.
        n_views: Number of templates of each.

    Attributes:
        starts: First number of the experiences of each map, and the number of all.
        template: Template of each experience among those of all maps; ``NO_TEMPLATE``: none.
    """

    def __init__(self, maps: Sequence[ExperienceMap], n_views: Sequence[int]) -> None:
        self.starts = np.cumsum([0, *(one.n for one in maps)])
        views = np.cumsum([0, *n_views])
        own = [one.experiences.array("template") for one in maps]
        self.template = np.concatenate(
            [np.where(t == NO_TEMPLATE, t, t + views[i]) for i, t in enumerate(own)]
        )
        self.source, self.target = (
            np.concatenate(
                [one.links_table.array(end) + self.starts[i] for i, one in enumerate(maps)]
            )
            for end in ("source", "target")
        )
        self._poses = np.concatenate([one.poses for one in maps])
        lengths = [one.links_table.array("distance_m") for one in maps]
        self._link_m = [float(np.median(some)) if len(some) else 0.0 for some in lengths]

    @property
    def n(self) -> int:
        """Number of experiences."""
        return len(self.template)

    def locate(self, experience: int) -> tuple[int, int]:
        """Return the map of an experience, and its id there."""
        where = int(np.searchsorted(self.starts, experience, side="right")) - 1
        return where, experience - int(self.starts[where])

    def near(self, experience: int, back: int, ahead: int) -> np.ndarray:
        """Return which experiences are at most so many links behind or ahead of one."""
        return within_links(experience, back, ahead, self.source, self.target, self.n)

    def beside(self, experience: int) -> np.ndarray:
        """Return which experiences of its map lie beside one and have its heading."""
        where, _ = self.locate(experience)
        apart = self._poses - self._poses[experience]
        close = np.hypot(apart[:, 0], apart[:, 1]) <= _BESIDE[0] * self._link_m[where]
        close &= np.cos(apart[:, 2]) >= np.cos(_BESIDE[1])
        close[: self.starts[where]] = close[self.starts[where + 1] :] = False
        return close


class _Streak(Scalars):
    """Frames in a row that agree on a place.

    Attributes:
        frames: Frames in which the robot moved since the evidence began.
        streak: How many agree on ``candidate``.
        candidate: Experience of the graph of all stored maps.
        began: Where the candidates of the streak began.
        passed: Experiences that the candidates have passed since.
        alike: Match error with the candidates, as a share of the mean one, summed over the streak.
        error: Match error with the present candidate.
        since_sudden: Frames since the view changed much between two frames.
    """

    frames: int
    streak: int
    candidate: int
    began: int
    passed: int
    alike: float
    error: float
    since_sudden: int


class StoredSequence(Mergeable):
    """Decides from a sequence of views where on the stored maps the robot is.

    The recursion is that of the present map, :mod:`neuroslam.mapping.sequence`, and so are the
    limits: a place is believed after ``confirm_frames`` frames in a row that lead over any other
    part of any stored map, and pass ``confirm_experiences`` experiences along the links.

    Args:
        config: Limits of the evidence.
    """

    def __init__(self, config: SequenceConfig) -> None:
        super().__init__()
        self.config = config
        self.evidence = GrowingTable({"cost": ((), torch.float64)})
        self.state = _Streak(
            frames=0, streak=0, candidate=NO_EXPERIENCE, began=NO_EXPERIENCE, passed=0,
            alike=0.0, error=1.0, since_sudden=_LONG,
        )  # fmt: skip

    @classmethod
    def faults(cls, state: Mapping[str, np.ndarray], n_experiences: int) -> Iterator[str]:
        """Yield what is invalid in a state, for stored maps of so many experiences."""
        rows = len(state["evidence.cost"])
        if rows > n_experiences:
            yield (
                f"recognition.sequence: {rows} rows for {n_experiences} experiences of stored maps"
            )
        for name in ("candidate", "began"):
            if not NO_EXPERIENCE <= int(state[f"state.{name}"]) < rows:
                yield f"recognition.sequence.state.{name}: no experience {state[f'state.{name}']}"

    def forget(self) -> None:
        """Begin again: the robot may be anywhere, or the stored maps have changed."""
        self.evidence.replace(cost=self.evidence["cost"][:0])
        self.state.frames, self.state.error = 0, 1.0
        self._end_streak()

    def _end_streak(self) -> None:
        s = self.state
        s.streak, s.passed, s.alike = 0, 0, 0.0
        s.candidate = s.began = NO_EXPERIENCE

    @property
    def believed(self) -> bool:
        """Whether enough frames in a row agree on a place, and their views resemble it."""
        s, c = self.state, self.config
        enough = s.streak >= c.confirm_frames and s.passed >= c.confirm_experiences
        return enough and s.alike <= c.alike * s.streak

    @property
    def after_jump(self) -> bool:
        """Whether a sudden change of view came shortly before the frames that agree."""
        return self.state.since_sudden <= self.state.streak + self.config.memory_frames

    def judge(self, errors: np.ndarray, graph: StoredGraph, change: float = 0.0) -> bool:
        """Take the match errors of a frame of a moving robot into the evidence.

        Args:
            errors: Match error with the view of every experience, ``(n,)``.
            graph: The stored maps.
            change: Difference of the view from that of the last frame.

        Returns:
            Whether a place is believed: ``state.candidate``.
        """
        s, c = self.state, self.config
        if graph.n < c.min_experiences:
            return False
        while self.evidence.n < graph.n:
            self.evidence.append(cost=0.0)
        sudden = change > _SUDDEN * float(errors.mean())
        s.since_sudden = 0 if sudden else min(s.since_sudden + 1, _LONG)
        relative = relative_errors(errors, np.ones(graph.n, dtype=bool))
        memory = min(1.0 - 1.0 / c.memory_frames, s.frames / (1.0 + s.frames))
        before = self.evidence.array("cost")
        costs = advance_costs(before, relative, graph.source, graph.target, memory)
        before[:] = costs
        s.frames += 1
        best = int(costs.argmin())
        rival = np.where(graph.near(best, _APART, _APART) | graph.beside(best), UNKNOWN, costs)
        if not (costs[best] < -c.believe and costs[best] < rival.min() - c.margin):
            self._end_streak()
            return False
        if s.candidate == NO_EXPERIENCE or not graph.near(s.candidate, 1, _AHEAD)[best]:
            self._end_streak()
            s.began = best
        elif best not in (s.candidate, s.began):
            s.passed += 1
        s.streak, s.candidate, s.error = s.streak + 1, best, float(errors[best])
        s.alike += s.error / float(errors.mean())
        return self.believed

    def renumber(self, change: Renumbering) -> None:
        """Do nothing: stored maps forget nothing."""

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Begin again: the stored maps have changed."""
        return StoredSequence(self.config).state_dict()
