r"""Clone cells: a belief over all experiences of the map, where several places look the same.

:mod:`neuroslam.cells.clone_steps` has the equations, :mod:`neuroslam.config.clones` the parameters.
Its votes are asked by the tracker of
sequences (:mod:`neuroslam.brain.tracker`): a loop closure that the belief does not support is not
made, and one that it is sure of is made without waiting for an evidence that lookalikes dilute.
"""

import math
from collections.abc import Iterator, Mapping
from typing import ClassVar, Self, cast

import numpy as np
import torch

from neuroslam.cells.clone_steps import (
    LEAST,
    advance_belief,
    entropy_bits,
    reach,
    view_evidence,
)
from neuroslam.config import BrainConfig
from neuroslam.config.clones import CloneConfig
from neuroslam.geometry import TWO_PI
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State, without_gradients
from neuroslam.state.population import LeadableMap, Picture, Population
from neuroslam.state.registry import register
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_EXPERIENCE, Motion, Pose

_FEW = 12
"""Experiences of earlier ground that are needed to know what a usual match error is."""

_RECENT = 10.0
"""Path behind the robot, in links, on which no loop can close: it looks like the present."""

_LEAVES_ANYWAY = 1e-6
"""Rate at which the robot leaves known ground where odometry says that it does not."""

_TURNED = 0.15
"""Turn, rad, after which the belief is updated too."""

_SAME_HEADING = math.cos(0.8)
"""Cosine of the largest difference of heading of one place."""

_IN_REACH = math.exp(-4.5)
"""Least value of :func:`~neuroslam.cells.clone_steps.reach` of a link: three deviations."""

_COLUMNS = (
    "belief", "since_m", "turn_rad", "copy", "copy_since_m", "copy_turn_rad", "reach", "at_m",
    "x_m", "y_m",
)  # fmt: skip

_WORST_DRIFT, _WORST_TURN, _NOT_THERE = 0.25, 0.6, math.exp(-2.0)
"""Drift (a share of the path) and heading error (rad) of a bad odometry, and the reach below which
even that does not explain a place."""

_UNCHANGED = 4.0
"""Distance from an experience, in sizes of one, at which its view must have changed."""

_MEMORY = 500
"""Updates over which the usual match error is averaged."""

_PICTURE = 64
"""Columns and rows of the picture of the belief."""

_LONG_AGO_M = -1e6
"""Odometer at which the robot was at experiences of another session."""


Links4 = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Source, target, length and turn of every link."""


class _Now(Scalars):
    """What is remembered between frames, beside the belief.

    Attributes:
        unknown: Belief in unknown ground that looks like no known place.
        odometer_m: Path driven.
        fixed_m: Odometer when the robot was last on known ground for sure.
        moved_m: Path since the last update.
        turned_rad: And turn.
        sure_m: Path over which the belief has been sure of one place.
        best: Experience with most belief around it; -1: the ground is rather unknown.
        mass: Belief around it.
        link_m: Median length of a link; 0 before the first.
        frames: Number of updates.
        usual: Running mean of the match errors with places elsewhere.
        explored_m: Path on new ground.
        repeats_m: Path on which new ground looked like places that it cannot be.
    """

    unknown: float
    odometer_m: float
    fixed_m: float
    moved_m: float
    turned_rad: float
    sure_m: float
    best: int
    mass: float
    link_m: float
    frames: int
    usual: float
    explored_m: float
    repeats_m: float


@register("clones")
class CloneCells(Population):
    """Belief over the experiences, one clone cell each; it votes where the robot is.

    Args:
        config: Rates and limits of the belief.
        place_m: Size of an experience of the map.

    Example:
        >>> cells = CloneCells()
        >>> cells.counts()["clones_entropy_bits"]
        0.0
    """

    config_section = CloneConfig
    needs_views = True
    rate_units: ClassVar[Mapping[str, str]] = {"clones": "1"}

    def __init__(self, config: CloneConfig | None = None, place_m: float = 0.5) -> None:
        super().__init__()
        self.config = config or CloneConfig()
        self.place_m = place_m
        self.clones = GrowingTable({name: ((), torch.float64) for name in _COLUMNS})
        self.now = _Now(
            unknown=1.0, odometer_m=0.0, fixed_m=0.0, moved_m=0.0, turned_rad=0.0, sure_m=0.0,
            best=NO_EXPERIENCE, mass=0.0, link_m=0.0, frames=0, usual=0.0,
            explored_m=0.0, repeats_m=0.0,
        )  # fmt: skip
        self._poses = np.empty((0, 3))  # of the map in this frame

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the population of a brain, for experiences of the size that its map has."""
        cells = config.pose_cells
        section = cast(CloneConfig, config.section(cls.kind))
        return cls(section, cells.create_threshold_cells * cells.cell_size_m)

    # ------------------------------------------------------------------------------ a frame

    @without_gradients
    def weigh(
        self, errors: np.ndarray, map_: LeadableMap, motion: Motion, tracks: bool, alarm: bool
    ) -> None:
        """Advance the belief by the motion and the match errors of a frame."""
        now, c = self.now, self.config
        self._poses = map_.pose_table
        while self.clones.n < map_.n:
            self.clones.append(**dict.fromkeys(_COLUMNS, 0.0) | {"at_m": now.odometer_m})
        moved = max(motion.v_m_s, 0.0) * motion.dt_s
        now.odometer_m += abs(motion.v_m_s) * motion.dt_s
        now.moved_m += moved
        now.turned_rad += motion.w_rad_s * motion.dt_s
        if alarm and map_.n:
            self._spread_out()
        now.explored_m += 0.0 if tracks else moved
        if not tracks and not self.votes and self._away(map_) >= _UNCHANGED:
            now.repeats_m += _UNCHANGED * self.place_m  # so far, and the view has not changed
        lengths = map_.links_table.array("distance_m")
        now.link_m = float(np.median(lengths)) if len(lengths) else 0.0
        if now.link_m and (
            now.moved_m >= c.every_links * now.link_m or abs(now.turned_rad) >= _TURNED
        ):
            self._update(errors, map_, tracks)

    def _spread_out(self) -> None:
        """Believe after an abrupt change of view that the robot may be anywhere."""
        belief, now = self.clones.array("belief"), self.now
        belief[:] = 0.5 * belief + 0.5 / len(belief)
        self.clones.array("copy")[:] *= 0.5
        now.unknown *= 0.5
        now.sure_m = 0.0

    def _update(self, errors: np.ndarray, map_: LeadableMap, tracks: bool) -> None:
        """Take a frame into the belief; the equation is in :mod:`neuroslam.cells.clone_steps`."""
        now, c, link_m = self.now, self.config, self.now.link_m
        moved = now.moved_m, now.turned_rad
        now.moved_m = now.turned_rad = 0.0
        at_m = self.clones.array("at_m")
        poses = map_.pose_table
        self.clones.array("x_m")[:], self.clones.array("y_m")[:] = poses[:, 0], poses[:, 1]
        at_m[map_.current] = now.odometer_m
        path_m = now.odometer_m - at_m
        earlier = path_m > _RECENT * link_m
        n_earlier = int(earlier.sum())
        if n_earlier < _FEW:
            return
        path_m = np.minimum(path_m, now.odometer_m - now.fixed_m)
        reached = reach(
            poses, map_.pose, path_m, c.spread_links * link_m, c.drift,
            math.radians(c.spread_deg), math.radians(c.drift_deg) / link_m,
        )  # fmt: skip
        reached = np.where(earlier, reached, 0.0)
        mapped = float(reached.max())  # whether odometry has the robot on known ground
        table = map_.links_table.array
        links = table("source"), table("target"), table("distance_m"), table("facing_rad")
        ahead, since, left = self._advance("belief", "", links, moved)
        copy, copy_since, copy_left = self._advance("copy", "copy_", links, moved)
        path = moved[0] / link_m
        leaves = min((c.leave * (1.0 - mapped) + _LEAVES_ANYWAY) * path, 1.0)
        closes = min(c.close * path, 1.0)
        kidnaps = min(c.kidnaps * path, 1.0)
        repeats, ends = min(c.repeats * path, 1.0), min(c.leave * path, 1.0)

        plain = now.unknown + left + copy_left + leaves * float(ahead.sum())
        plain += ends * float(copy.sum())
        begins = repeats * (plain + float(copy.sum()) * (1.0 - ends))
        copies = goes_on = copy * (1.0 - ends) * (1.0 - repeats)
        copies = copies + begins * earlier * (1.0 - reached) / n_earlier
        plain *= 1.0 - repeats
        # Density of the place by odometry along the path: of the whole path it adds up to 1.
        spread_m = c.spread_links * link_m + c.drift * path_m
        there = reached * link_m / (math.sqrt(TWO_PI) * spread_m)
        there *= closes / max(1.0, float(there.sum()))
        arrives = (plain + float(copies.sum())) * there
        follows = ahead * (1.0 - leaves)
        known = (follows + arrives) * (1.0 - kidnaps) + kidnaps * earlier / n_earlier
        stay = (1.0 - float(there.sum())) * (1.0 - kidnaps)
        copies, plain = copies * stay, plain * stay

        others = errors[earlier]
        now.frames += 1
        now.usual += (float(others.mean()) - now.usual) / min(now.frames, _MEMORY)
        seen = view_evidence(errors, others, now.usual, c.alike, c.gain, c.least, c.most)
        likelihood = np.exp(seen - max(float(seen.max()), 0.0))
        weighed, copied = known * likelihood, copies * likelihood
        plain *= math.exp(-max(float(seen.max()), 0.0))
        total = float(weighed.sum() + copied.sum()) + plain
        now.unknown = plain / total
        # A part of the belief that has just arrived has driven nothing from there.
        since *= (follows * (1.0 - kidnaps) / np.maximum(known, LEAST))[:, None]
        copy_since *= (goes_on * stay / np.maximum(copies, LEAST))[:, None]
        self._store("belief", "", weighed / total, since)
        self._store("copy", "copy_", copied / total, copy_since)
        self.clones.array("reach")[:] = reached
        self._notice_repeats(poses, map_.pose, path_m, moved[0])
        self._find_best(links, moved[0])
        at = now.best != NO_EXPERIENCE and self._near_to(now.best)[map_.current]
        if tracks and at and now.mass >= c.sure:
            now.fixed_m = now.odometer_m

    def _advance(
        self, name: str, prefix: str, links: Links4, moved: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Move a belief along the links; what leaves the map comes last."""
        since = (self.clones.array(f"{prefix}{of}") for of in ("since_m", "turn_rad"))
        belief = self.clones.array(name)
        return advance_belief(belief, np.stack(list(since), axis=1), *links, moved, self.now.link_m)

    def _store(self, name: str, prefix: str, belief: np.ndarray, since: np.ndarray) -> None:
        self.clones.array(name)[:] = np.where(belief > LEAST, belief, 0.0)
        for column, of in enumerate(("since_m", "turn_rad")):
            self.clones.array(f"{prefix}{of}")[:] = since[:, column]

    @property
    def unknown(self) -> float:
        """Belief that the robot is on ground that the map does not know, whatever it looks like."""
        return self.now.unknown + float(self.clones.array("copy").sum())

    def _notice_repeats(
        self, poses: np.ndarray, here: Pose, path_m: np.ndarray, moved_m: float
    ) -> None:
        """Count the path on which new ground looks like a place that it cannot be.

        Even by an odometry far worse than usual: else it may be a loop that closes.
        """
        copy, now = self.clones.array("copy"), self.now
        if float(copy.sum()) < self.config.sure:
            return
        best, link_m = int(copy.argmax()), now.link_m
        spread_m = self.config.spread_links * link_m
        far = reach(
            poses[best : best + 1], here, path_m[best : best + 1], spread_m, _WORST_DRIFT,
            _WORST_TURN, 0.0,
        )  # fmt: skip
        if far[0] < _NOT_THERE:
            now.repeats_m += moved_m

    @property
    def votes(self) -> bool:
        """Whether places of this world have been seen to look the same: before, it abstains."""
        now, c = self.now, self.config
        return now.repeats_m >= max(c.notice * self.place_m, c.notice_share * now.explored_m)

    def _follows(self, before: int, best: int, links: Links4, moved_m: float) -> bool:
        """Return whether the best place has moved as the robot has: on, or along a link."""
        if min(before, best) == NO_EXPERIENCE:
            return False
        far_m = self.config.near_links * self.now.link_m + 2.0 * moved_m
        on = math.dist(self._poses[before, :2], self._poses[best, :2]) <= far_m
        return on or bool(((links[0] == before) & (links[1] == best)).any())

    def _find_best(self, links: Links4, moved_m: float) -> None:
        """Find the place with most belief, and how far the robot has driven with it."""
        now, c = self.now, self.config
        before = now.best
        now.best = int(self.clones.array("belief").argmax())
        now.mass = self._belief_at(now.best)
        if self.unknown > now.mass:
            now.best, now.mass = NO_EXPERIENCE, self.unknown
        jumped = before != now.best and not self._follows(before, now.best, links, moved_m)
        now.sure_m = 0.0 if jumped or now.mass < c.sure else now.sure_m + moved_m

    def _near_to(self, experience: int) -> np.ndarray:
        """Return which experiences are the same place as one: near, and with its heading."""
        apart = self._poses - self._poses[experience]
        close = np.hypot(apart[:, 0], apart[:, 1]) <= self.config.near_links * self.now.link_m
        return close & (np.cos(apart[:, 2]) >= _SAME_HEADING)

    def _belief_at(self, experience: int) -> float:
        return float(
            self.clones.array("belief")[: len(self._poses)][self._near_to(experience)].sum()
        )

    # ---------------------------------------------------------------------------- its votes

    def supports(self, experience: int) -> bool:
        """Tell whether the robot may be at an experience; -1: on ground that is not mapped."""
        if not self.votes:
            return True
        if experience == NO_EXPERIENCE:
            return self.unknown >= self.config.sure
        return experience < len(self._poses) and self._belief_at(experience) >= self.config.support

    def reaches(self, experience: int) -> bool:
        """Tell whether odometry explains that the robot has driven to an experience."""
        if not self.votes:
            return True
        return experience < self.clones.n and bool(
            self.clones.array("reach")[experience] >= _IN_REACH
        )

    def proposes(self) -> int | None:
        """Return where the robot is for sure; -1: on unknown ground; ``None``: that is not sure."""
        now, c = self.now, self.config
        sure = now.mass >= c.sure and now.sure_m >= c.confirm_links * now.link_m
        return now.best if sure and self.votes else None

    def splits(self, map_: LeadableMap) -> bool:
        """Tell whether a view that did not change needs a clone of its own here."""
        return self._away(map_) >= (self.config.split if self.votes else _UNCHANGED)

    def _away(self, map_: LeadableMap) -> float:
        """Return how far the robot is from the current experience, in sizes of one."""
        if map_.current == NO_EXPERIENCE:
            return 0.0
        at = map_.pose_table[map_.current, :2]
        return math.dist(map_.pose[:2], at) / self.place_m

    # ------------------------------------------------------------------- questions of other parts

    @property
    def rates(self) -> np.ndarray:
        """Belief of every clone cell, ``(n_experiences,)``."""
        return self.clones.array("belief").copy()

    @property
    def entropy_bits(self) -> float:
        """How uncertain the place is; 0: it is known."""
        return entropy_bits(self.clones.array("belief"), self.unknown)

    def counts(self) -> dict[str, float]:
        """Return the number of clone cells, and how uncertain the place is at the end."""
        return {"clone_cells": self.clones.n, "clones_entropy_bits": self.entropy_bits}

    def scalars(self) -> dict[str, float]:
        """Return the entropy, the belief in unknown ground and that in the best place."""
        return {
            "clones/entropy_bits": self.entropy_bits,
            "clones/unknown": self.unknown,
            "clones/best_place": self.now.mass,
            "clones/repeats_m": self.now.repeats_m,
        }

    def images(self) -> dict[str, Picture]:
        """Draw the belief over the map, north up."""
        if not self.clones.n:
            return {}
        x, y, belief = (self.clones.array(name) for name in ("x_m", "y_m", "belief"))
        size = max(float(np.ptp(x)), float(np.ptp(y)), 1e-9)
        picture = np.zeros((_PICTURE, _PICTURE))
        columns = ((x - x.min()) / size * (_PICTURE - 1)).astype(int)
        rows = _PICTURE - 1 - ((y - y.min()) / size * (_PICTURE - 1)).astype(int)
        np.maximum.at(picture, (rows, columns), 0.15)  # the map, faintly
        np.maximum.at(picture, (rows, columns), np.sqrt(belief))
        return {"cells/clones": picture}

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield a belief that is none, and rows without an experience."""
        belief, copy = state["clones.belief"], state["clones.copy"]
        unknown = float(state["now.unknown"])
        if len(belief) > n_experiences:
            yield f"{cls.name}.clones: {len(belief)} rows for {n_experiences} experiences"
        if (belief < 0).any() or (copy < 0).any() or unknown < 0:
            yield f"{cls.name}.clones.belief: negative"
        total = float(belief.sum() + copy.sum()) + unknown
        if abs(total - 1.0) > 1e-6:
            yield f"{cls.name}.clones.belief: adds up to {total:.6g}, expected 1"
        if not NO_EXPERIENCE <= int(state["now.best"]) < max(n_experiences, len(belief), 1):
            yield f"{cls.name}.now.best: no experience {int(state['now.best'])}"

    # --------------------------------------------------------------------------- merging

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Keep the belief of the session that goes on, under the ids of the merged map.

        Nothing else is learnt: the transitions are the links of the map. Loaded experiences that
        the session did not meet get no belief, and count as places of long ago.
        """
        n = join.n_experiences + len(join.kept_experiences)
        merged: State = {name: value for name, value in partial.items() if name[:4] == "now."}
        to = torch.from_numpy(join.experiences[: len(partial["clones.belief"])])
        for name in _COLUMNS:
            column = partial[f"clones.{name}"]
            rows = column.new_full((n,), _LONG_AGO_M if name == "at_m" else 0.0)
            if name in ("belief", "copy"):
                merged[f"clones.{name}"] = rows.index_add(0, to, column)
            else:
                rows[to] = column
                merged[f"clones.{name}"] = rows
        best = int(partial["now.best"])
        new = int(join.experiences[best]) if 0 <= best < len(join.experiences) else NO_EXPERIENCE
        merged["now.best"] = partial["now.best"].new_tensor(new)
        merged["now.sure_m"] = torch.zeros_like(partial["now.sure_m"])
        return merged

    def renumber(self, change: Renumbering) -> None:
        """Follow a map that forgets: the belief of what became part of another goes there."""
        n = self.clones.n
        columns = {
            name: change.rows_of_experiences(self.clones[name]) for name in self.clones.columns
        }
        kept = len(columns["belief"])
        to = np.minimum(change.experiences[:n], kept - 1)
        for name in ("belief", "copy"):
            belief = np.zeros(kept)
            np.add.at(belief, np.maximum(to, 0), self.clones.array(name))
            columns[name] = torch.from_numpy(belief)
        self.clones.replace(**columns)
        self.now.best = change.experience(self.now.best)
        self.now.sure_m = 0.0
        self._poses = np.empty((0, 3))
