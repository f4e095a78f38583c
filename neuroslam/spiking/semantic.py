"""The semantic cells of a brain: SSP-SLAM that meets new landmarks as it goes, in metres."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Literal, Self

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.config import BrainConfig
from neuroslam.config.semantic import SemanticConfig
from neuroslam.errors import MapError, listed
from neuroslam.geometry import wrap_angle
from neuroslam.sensors.markers import MarkerDetector
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.landmark_frames import from_frame, into_frame, rotated, shared_frames
from neuroslam.spiking.landmark_matching import match_landmarks
from neuroslam.spiking.sightings import (
    LEAST_SEEN,
    NAMED,
    NAMELESS,
    VIEW,
    LandmarkUpdate,
    Sightings,
)
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State, without_gradients
from neuroslam.state.population import (
    Belief,
    Correction,
    Decision,
    LeadableMap,
    Observation,
    Population,
    StepInput,
)
from neuroslam.state.registry import register
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, Frame, Motion, Pose, PoseEstimate
from neuroslam.worlds.landmarks import LandmarkView

_KINDS = ("landmark", "view", "nameless")
_KNOWN = 0.5  # strength of a recall from which a landmark is known
_CLEAR = 0.7  # of its strength, that a recall is like the place that is read from it
_STEPS = 3  # of Newton's method, from where a landmark is seen to where it is recalled
_CONSENSUS = 3  # known landmarks in sight, from which on they can outvote one
_MOVED_M = 0.05  # by which a landmark moves with its experience before memory is rewritten
_NEAR_M = 0.5  # nearer landmarks say nothing of the heading


@register("semantic")
class SemanticCells(Population):
    r"""Learns where landmarks are, as vectors, and is corrected by those that it knows.

    One animal of :class:`~neuroslam.spiking.slam.SSPSLAM`, with a vocabulary that grows: a pointer
    of a landmark follows from its kind and number, so that it is the same in every session. Each
    landmark in sight is first named: nameless ones by the place where they seem to be; those are
    dropped that most others in sight contradict.

    State: ``known``, a row for each landmark (kind, number, place as recalled, how often seen,
    how sure the robot was of its own place), ``slam`` and the heading in ``now``.

    Args:
        config: Of SSP-SLAM and of what a landmark is.
        heading_rad: At the start.
        follows: ``nothing``: the cells are alone; ``map``: landmarks are kept with the experiences
            of a map, and move with them; ``cells``: others believe where the robot is, and weigh
            themselves what landmarks tell: the memory pulls at nothing.

    Example:
        >>> cells = SemanticCells(SemanticConfig())
        >>> door = Sightings.of(np.array([[7.0, 2.0, 0.0]]))
        >>> for _ in range(20):
        ...     told = cells.advance(Motion(0.0, 0.0, 0.1), door)
        >>> cells.landmarks()["place_m"].round(1).tolist() == [[2, 0]]
        True
    """

    merge_sections = ("semantic",)
    rank = 1
    compass = "uses"

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the semantic cells of a brain."""
        follows = "nothing" if leader is cls else "map" if leader.relaxes_map else "cells"
        cells = cls(config.semantic, math.radians(config.map.initial_heading_deg), follows)
        if "markers" in config.semantic.landmarks:
            c = config.semantic
            cells.detector = MarkerDetector(
                c.markers, c.marker_size_m, config.odometry.fov_deg, config.view.panoramic
            )
        return cells

    def __init__(
        self,
        config: SemanticConfig,
        heading_rad: float = 0.0,
        follows: Literal["nothing", "map", "cells"] = "nothing",
    ) -> None:
        super().__init__()
        self.config = config
        self.follows = follows
        self.detector: MarkerDetector | None = None  # of landmarks in pictures
        self._update: LandmarkUpdate | None = None  # of the last frame
        self.known = GrowingTable(
            {
                "kind": ((), torch.int64),
                "number": ((), torch.int64),
                "place_m": ((2,), torch.float64),
                "seen": ((), torch.int64),
                "variance_m2": ((), torch.float64),
                "first_frame": ((), torch.int64),
                "experience": ((), torch.int64),
                "offset_m": ((2,), torch.float64),
            }
        )
        pulls = config.model_copy(update={"gain": 0.0}) if follows == "cells" else config
        self.slam = SSPSLAM(pulls, _pointer(config, NAMED, 0)[None])
        self.decoder = PositionDecoder(self.slam.space)
        self.now = Scalars(
            heading_rad=heading_rad,
            owed_s=0.0,  # of time that no whole step has lived yet
            frame=-1,
            told=-1,  # landmark that has told where the robot is, in this turn of attention
        )
        self.slam.start(torch.zeros(1, 2))
        self.watch: Callable[[int, SSPStep], None] | None = None  # a recorder's, of each step
        self._rows: dict[tuple[int, int], int] = {}
        self.register_load_state_dict_pre_hook(_take_pointers)
        self.register_load_state_dict_post_hook(lambda module, _: module._index())

    @property
    def n(self) -> int:
        """Number of landmarks that count: seen more than a time or two."""
        return int(self.confirmed().sum())

    def confirmed(self) -> Tensor:
        """Tell of each row of ``known`` whether it was seen so often that it is no mistake."""
        return (self.known["seen"] >= LEAST_SEEN) | (self.known["kind"] == VIEW)

    @property
    def pose(self) -> Pose:
        """Where the cells say that the robot is."""
        x, y = self.slam.integrator.position_m[0].tolist()
        return Pose(x, y, self.now.heading_rad)

    def landmarks(self) -> dict[str, np.ndarray]:
        """Return the columns of the landmarks that count, and their names."""
        rows = self.confirmed()
        columns = {c: self.known[c][rows].numpy(force=True).copy() for c in self.known.columns}
        both = zip(columns["kind"].tolist(), columns["number"].tolist(), strict=True)
        return columns | {"name": np.array([f"{_KINDS[k]}_{n}" for k, n in both], dtype=str)}

    def observe(self, frame: Frame) -> Sightings:
        """Return the landmarks in sight: those that the source gives, and markers in the picture.

        Raises:
            BadFrame: If they cannot be that.
        """
        tables = []
        if "given" in self.config.landmarks and frame.landmarks is not None:
            tables.append(frame.landmarks)
        if self.detector is not None and frame.image is not None:
            tables.append(self.detector(frame.image))
        return Sightings.of(*tables)

    def check(self, now: StepInput, observation: Observation, belief: Belief | None) -> None:
        """Refuse a frame that would take the robot out of the space of the vectors.

        Raises:
            MapError: If so.
        """
        start = self.pose if belief is None else belief.pose
        heading = now.compass_rad if belief is None else None
        self._stay_inside(self._dead_reckoned(start, now.motion, heading)[:2])

    @staticmethod
    def _dead_reckoned(start: Pose, motion: Motion, compass_rad: float | None) -> Pose:
        heading = compass_rad
        if heading is None:
            heading = wrap_angle(start.theta_rad + motion.w_rad_s * motion.dt_s)
        length = motion.v_m_s * motion.dt_s
        return Pose(
            start.x_m + length * math.cos(heading), start.y_m + length * math.sin(heading), heading
        )

    def recall(
        self, now: StepInput, observation: Sightings, belief: Belief | None
    ) -> Correction | None:
        """Learn the landmarks in sight, and tell where known ones put the robot.

        A map whose relaxation has moved the robot out of the space is not corrected; the next frame
        is refused.
        """
        self._update = None
        if belief is not None and not self._is_inside(belief.pose[:2]):
            return None
        landmarks = observation
        if "views" in self.config.landmarks and now.view.template != NO_TEMPLATE:
            landmarks = landmarks.with_view(now.view.template)
        if belief is not None and self.follows == "map":
            self.follow_map(belief.poses)
        update = self.advance(
            now.motion, landmarks, compass_rad=now.compass_rad, belief=belief, frame=now.frame
        )
        self._update = update
        heading = self.now.heading_rad if belief is None else belief.pose.theta_rad
        return Correction(
            *update.correction_m,
            update.turn_rad,
            heading,
            update.place_m,
            self.config.sigma_m,
            update.variance_m2,
            update.lost,
        )

    @property
    def estimate(self) -> PoseEstimate:
        """Position in metres, as ``frames.csv`` has it of a brain without pose cells."""
        x, y, _ = self.pose
        return PoseEstimate(x, y, 0.0)

    @property
    def lost(self) -> bool:
        """Whether a known landmark has just put the robot where it was not believed to be."""
        return self._update is not None and self._update.lost

    def belief(self, map_: LeadableMap) -> Belief:
        """Return the pose of the cells."""
        return Belief(self.pose)

    def decide(self, map_: LeadableMap, now: StepInput) -> Decision:
        """Go to the experience of the landmark that is attended to; each landmark is one."""
        row = -1 if self._update is None else self._update.landmark
        experience, at = self.experience_of(row, map_.n)
        return Decision(*map_.visit(experience, self.pose, now.motion.dt_s, now.frame, at))

    @property
    def rates(self) -> np.ndarray:
        """Real, then imaginary part of each oscillator of the path integrator."""
        z = self.slam.integrator.z.flatten().numpy(force=True)
        return np.concatenate([z.real, z.imag])

    def counts(self) -> dict[str, float]:
        """Return the number of landmarks that count."""
        return {"landmarks": self.n}

    def scalars(self) -> dict[str, float]:
        """Return what TensorBoard shows."""
        return {
            "semantic/landmarks": float(self.n),
            "semantic/contradicted_s": float(self.slam.contradicted_s[0]),
        }

    def tables(self) -> dict[str, str]:
        """Return ``landmarks.csv``: name,x_m,y_m,seen,first_frame,experience."""
        known = self.landmarks()
        columns = ("name", "place_m", "seen", "first_frame", "experience")
        rows = zip(*(known[column].tolist() for column in columns), strict=True)
        lines = [f"{name},{x!r},{y!r},{n},{f},{e}" for name, (x, y), n, f, e in rows]
        return {
            "landmarks.csv": "\n".join(["name,x_m,y_m,seen,first_frame,experience", *lines, ""])
        }

    def points_m(self) -> np.ndarray:
        """Return where landmarks are on the map, ``(n, 2)``, views left out."""
        known = self.landmarks()
        return known["place_m"][known["kind"] != VIEW]

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Say where pointers are missing, or landmarks were met at experiences that are not."""
        pointers, kinds = len(state["slam.pointers"]), len(state["known.kind"])
        if pointers != max(1, kinds):
            yield f"{kinds} landmarks, {pointers} pointers; each should have its own"
        at = state["known.experience"]
        rows = np.flatnonzero((at < -1) | (at >= n_experiences))
        if len(rows):
            yield (
                f"landmarks {listed(rows)}: met at experiences {listed(at[rows])}, "
                f"there are {n_experiences}"
            )

    @without_gradients
    def advance(
        self,
        motion: Motion,
        seen: Sightings,
        *,
        compass_rad: float | None = None,
        belief: Belief | None = None,
        frame: int = 0,
    ) -> LandmarkUpdate:
        """Advance by a frame.

        Args:
            motion: Since the last frame.
            seen: Landmarks in sight at its end.
            compass_rad: Measured heading; ``None``: it is integrated.
            belief: Where a map or other cells say that the robot is; ``None``: it is alone.
            frame: Number of the frame.

        Raises:
            MapError: If the robot leaves the space; nothing has changed then.
        """
        now, before = self.now, self.pose
        if belief is None:
            *here, heading = self._dead_reckoned(before, motion, compass_rad)
            length = motion.v_m_s * motion.dt_s
            step = length * math.cos(heading), length * math.sin(heading)
        else:
            *here, heading = belief.pose
            step = here[0] - before.x_m, here[1] - before.y_m
        self._stay_inside(here)
        now.heading_rad, now.frame = heading, frame
        if belief is not None and math.hypot(*step) > float(self.slam.space.length_scale_m.min()):
            self.slam.start(torch.tensor([here]))  # others have jumped
            step = (0.0, 0.0)
        angle = seen.bearing_rad + heading
        vectors = np.column_stack([np.cos(angle), np.sin(angle)]) * seen.distance_m[:, None]
        places = np.array(here) + vectors
        rows, fresh = self._name(seen, places, belief)
        good = self._agreeing(rows, fresh, places)
        rows, vectors, kind = rows[good], vectors[good], seen.kind[good]
        attended, strength, gate, lost = self._steps(motion.dt_s, step, rows, vectors)
        if attended < 0:
            now.told = -1
            return LandmarkUpdate((0.0, 0.0), 0.0, None, 0.0, -1, False, False)
        vector = vectors[rows == attended][0]
        if strength > _KNOWN:
            self._note_place(attended, belief, np.array(here) + vector)
        place = None
        if bool(self.slam.familiar[0]) and (now.told != attended or lost):
            now.told = attended
            place = tuple((self.known["place_m"][attended].numpy() - vector).tolist())
        lost = lost and self._is_inside(place)
        if lost:  # its landmarks contradict for long: it was kidnapped, or has drifted far
            self.relocalise(place)
        correction, turn = (0.0, 0.0), 0.0
        if self.follows != "cells":
            if belief is None or gate > 0.5 or lost:
                after = self.pose
                correction = after.x_m - here[0], after.y_m - here[1]
            if compass_rad is None:
                turn = self._turn(motion.dt_s, rows, vectors, kind)
        sure = float(self.known["variance_m2"][attended])
        new = bool(fresh[good][rows == attended].any())
        return LandmarkUpdate(correction, turn, place, sure, attended, new, lost)

    @without_gradients
    def follow_map(self, poses: np.ndarray) -> bool:
        """Move landmarks with the experiences at which they were met, as the map was relaxed.

        Args:
            poses: Of all experiences, ``(n, 3)``.

        Returns:
            Whether one moved so far that the memory was written anew.
        """
        anchor = self.known["experience"].numpy()
        rows = np.flatnonzero(anchor >= 0)
        if not len(rows):
            return False
        place = self.known["place_m"].numpy()
        there = from_frame(poses[anchor[rows]], self.known["offset_m"].numpy()[rows])
        if np.abs(there - place[rows]).max() < _MOVED_M:
            return False
        self.known["place_m"][rows] = torch.from_numpy(there)
        self._write()
        return True

    def _write(self) -> None:
        """Make every landmark recall the place where it is noted to be."""
        slam = self.slam
        places = slam.space.encode(self.known["place_m"].to(slam.pointers)).detach()
        slam.map.write(slam.pointers, places)
        if slam.places is not None:
            slam.places.write(places, slam.pointers)

    def experience_of(self, row: int, n: int) -> tuple[int, Pose | None]:
        """Return the place of a map that a landmark is, and where; each is one, where it is alone.

        Args:
            row: Of the landmark, or -1.
            n: Places that the map has; a landmark that is none becomes the next.
        """
        if row < 0 or int(self.known["seen"][row]) < LEAST_SEEN:
            return -1, None
        if int(self.known["experience"][row]) < 0:
            self.known["experience"][row] = n
        x, y = self.known["place_m"][row].tolist()
        return int(self.known["experience"][row]), Pose(x, y, self.now.heading_rad)

    def relocalise(self, place_m: tuple[float, float]) -> None:
        """Put the animal somewhere; what it has learnt stays."""
        self._stay_inside(place_m)
        self.slam.start(torch.tensor([place_m]))

    def _stay_inside(self, place_m: tuple[float, float]) -> None:
        if not self._is_inside(place_m):
            raise MapError(
                f"semantic map: the robot is at {place_m[0]:.1f}, {place_m[1]:.1f} m, outside of "
                f"its space of +-{self.slam.space.bounds_m[0, 1]:g} m; raise semantic.space.reach_m"
            )

    def _is_inside(self, place_m: tuple[float, float]) -> bool:
        low, high = self.slam.space.bounds_m.T.tolist()
        return all(a <= x <= b for a, x, b in zip(low, place_m, high, strict=True))

    def _name(
        self, seen: Sightings, places_m: np.ndarray, belief: Belief | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Say which row each landmark in sight has, -1 for none, and which rows are new."""
        rows = np.full(len(seen.kind), -1)
        fresh = np.zeros(len(rows), dtype=bool)
        for i, (kind, number) in enumerate(zip(seen.kind.tolist(), seen.number.tolist(),
                                               strict=True)):  # fmt: skip
            if kind == NAMELESS:
                rows[i], number = self._nearest(places_m[i])
            else:
                rows[i] = self._rows.get((kind, number), -1)
            if rows[i] < 0 and number >= 0:
                rows[i], fresh[i] = self._meet(kind, number, places_m[i], belief), True
            if rows[i] >= 0:
                self.known["seen"][rows[i]] += 1
        return rows, fresh

    def _nearest(self, place_m: np.ndarray) -> tuple[int, int]:
        """Row of the nameless landmark there, or -1 and a number for it, or none where in doubt."""
        mine = np.flatnonzero(self.known["kind"].numpy() == NAMELESS)
        if not len(mine):
            return -1, 0
        away = np.linalg.norm(self.known["place_m"].numpy()[mine] - place_m, axis=1)
        order = np.argsort(away)
        same = self.config.same_m
        if away[order[0]] > 2.0 * same:
            return -1, len(mine)
        doubtful = len(away) > 1 and away[order[1]] < 2.0 * away[order[0]]
        if away[order[0]] > same or doubtful:
            return -1, -1
        return int(mine[order[0]]), 0

    def _meet(self, kind: int, number: int, place_m: np.ndarray, belief: Belief | None) -> int:
        """Take a landmark into the vocabulary."""
        experience, offset = -1, np.zeros(2)
        if belief is not None and belief.experience >= 0:  # on a map that is relaxed
            experience, offset = belief.experience, into_frame(belief.at, place_m)
        row = self.known.append(
            kind=kind,
            number=number,
            place_m=torch.from_numpy(place_m),
            seen=0,
            variance_m2=0.0 if belief is None else belief.variance_m2,
            first_frame=self.now.frame,
            experience=experience,
            offset_m=torch.from_numpy(offset),
        )
        pointer = _pointer(self.config, kind, number)[None].to(self.slam.pointers)
        self.slam.pointers = torch.cat([self.slam.pointers[:row], pointer])
        self._rows[kind, number] = row
        return row

    def _agreeing(self, rows: np.ndarray, fresh: np.ndarray, places_m: np.ndarray) -> np.ndarray:
        """Tell which landmarks in sight most others do not contradict."""
        good = rows >= 0
        known = good & ~fresh
        if known.sum() < _CONSENSUS:
            return good
        off = places_m[known] - self.known["place_m"].numpy()[rows[known]]
        apart = np.linalg.norm(off - np.median(off, axis=0), axis=1)
        limit = max(3.0 * self.config.sigma_m, 3.0 * float(np.median(apart)))
        good[known] = apart <= limit
        return good

    def _steps(
        self, dt_s: float, step_m: tuple[float, float], rows: np.ndarray, vectors: np.ndarray
    ) -> tuple[int, float, float, bool]:
        """Let SSP-SLAM live for the time of a frame; returns its last step.

        Returns:
            Landmark attended to or -1, how strongly it is recalled, how far the gate is open, and
            whether it is believed against the path.
        """
        slam, now, dt = self.slam, self.now, self.config.time_step_s
        now.owed_s += dt_s
        steps = math.floor(now.owed_s / dt + 1e-6)
        if steps == 0:  # frames are shorter than steps
            now.owed_s -= dt_s
            steps, now.owed_s = 1, 0.0
        else:
            now.owed_s -= steps * dt
        n = len(slam.pointers)
        in_view = np.zeros(n, dtype=bool)
        in_view[rows] = True
        low = np.zeros((n, 2))
        low[rows] = vectors
        distance = np.hypot(*low.T)
        in_view, distance = (np.tile(part, (steps, 1, 1)) for part in (in_view, distance))
        low = np.tile(low, (steps, 1, 1, 1))
        view = LandmarkView(in_view, distance, low, low, np.arange(n))
        velocity = torch.tensor(step_m) / (steps * dt)
        said = slam.run(velocity.expand(steps, 1, 2), view, self.watch)
        recall, gate, lost, attended = (
            part[-1, 0].item() for part in (said.recall, said.gate, said.lost, said.attended)
        )
        return attended, recall, gate, lost and bool(slam.familiar[0])

    def _note_place(self, row: int, belief: Belief | None, seen_m: np.ndarray) -> None:
        """Read out where the landmark is that is recalled."""
        recalled = torch.view_as_complex(self.slam.recalled)
        start = self.known["place_m"][row][None].to(recalled.real)
        place = self.decoder.track(recalled, start)
        clear = _CLEAR * float(recalled.abs().square().mean(-1).sqrt())
        if float(self.decoder.similarity(recalled, place)) < clear:  # first seen where it is not?
            again = torch.from_numpy(seen_m)[None].to(start)
            for _ in range(_STEPS):
                again = self.decoder.track(recalled, again)
            if float(self.decoder.similarity(recalled, again)) >= clear:
                place = again
        place = place[0].double()
        anchor = int(self.known["experience"][row])
        if anchor >= 0 and self.follows == "map":
            at = belief.poses[anchor]
            self.known["offset_m"][row] = torch.from_numpy(into_frame(at, place.numpy()))
        self.known["place_m"][row] = place

    def _turn(self, dt_s: float, rows: np.ndarray, vectors: np.ndarray, kind: np.ndarray) -> float:
        r"""Correct an integrated heading by the bearings of known landmarks.

        .. math:: \theta \leftarrow \theta - \kappa\,\Delta t\;
                  \mathrm{mean}_i\,\angle\bigl(d_i,\, m_i - x\bigr)

        with :math:`d_i` the vector seen and :math:`m_i` where the landmark is recalled to be.
        """
        known = (kind != VIEW) & (self.known["seen"].numpy()[rows] >= LEAST_SEEN)
        expected = self.known["place_m"].numpy()[rows] - np.array(self.pose[:2])
        known &= np.minimum(np.hypot(*expected.T), np.hypot(*vectors.T)) > _NEAR_M
        if not known.any():
            return 0.0
        (a, b), (x, y) = expected[known].T, vectors[known].T
        off = np.arctan2(a * y - b * x, a * x + b * y).mean()
        turn = -min(1.0, self.config.heading_rate_hz * dt_s) * float(off)
        self.now.heading_rad = wrap_angle(self.now.heading_rad + turn)
        return turn

    def _index(self) -> None:
        kinds, numbers = (self.known[c].tolist() for c in ("kind", "number"))
        self._rows = {key: i for i, key in enumerate(zip(kinds, numbers, strict=True))}

    @torch.no_grad()
    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Join the landmarks of two sessions in the frame of the loaded one, and write them anew.

        Landmarks of one name are one, views as the maps' are, nameless ones where they lie
        together. One that lies elsewhere now is where the partial session, the younger, saw it.
        """
        one, other = (SemanticCells(self.config, follows=self.follows) for _ in range(2))
        one.load_state_dict(loaded)
        other.load_state_dict(partial)
        there = self._moved(other.known["place_m"].numpy(), join)
        keys = {key: row for row, key in enumerate(one._rows)}
        columns = {c: one.known[c].tolist() for c in one.known.columns}
        free = sum(kind == NAMELESS for kind, _ in keys)
        for row, (kind, number) in enumerate(other._rows):
            if kind == VIEW:
                number = int(join.views[number])
            elif kind == NAMELESS:
                number, free = _same_nameless(one, there[row], free)
            theirs = {c: other.known[c][row].tolist() for c in columns}
            at = keys.get((kind, number))
            if theirs["experience"] >= 0:
                theirs["experience"] = int(join.experiences[theirs["experience"]])
                turn = float(join.turns_rad[other.known["experience"][row]])
                theirs["offset_m"] = rotated(np.array(theirs["offset_m"]), turn).tolist()
            if at is None:
                keys[kind, number] = len(columns["kind"])
                for c, value in (
                    theirs | {"number": number, "place_m": there[row].tolist()}
                ).items():
                    columns[c].append(value)
                continue
            mine = np.array(columns["place_m"][at])
            agree = np.linalg.norm(mine - there[row]) < self.config.same_m
            columns["place_m"][at] = ((mine + there[row]) / 2 if agree else there[row]).tolist()
            columns["seen"][at] += theirs["seen"]
            columns["variance_m2"][at] = min(columns["variance_m2"][at], theirs["variance_m2"])
        return self._written(other, columns, join)

    def frames(self, loaded: State, partial: State, join: Join) -> tuple[Pose, Pose] | None:
        """Say how two maps of landmarks alone lie by those that both know by name."""
        if self.follows != "nothing":
            return None
        return shared_frames(loaded, partial, same_m=self.config.same_m)

    def match(
        self, loaded: Population, maps: tuple[np.ndarray, np.ndarray], config: BrainConfig
    ) -> tuple[Match | None, str]:
        """Align the landmarks that two sessions know by name."""
        if not isinstance(loaded, SemanticCells):
            raise TypeError(f"SemanticCells: cannot be matched with {type(loaded).__name__}")
        states = loaded.state_dict(), self.state_dict()
        known = loaded.landmarks(), self.landmarks()
        return match_landmarks(states, known, maps, config)

    def _moved(self, points_m: np.ndarray, join: Join) -> np.ndarray:
        """Bring positions of the partial session, ``(n, 2)``, into the loaded one's frame."""
        if self.follows == "map":
            return join.place(np.column_stack([points_m, np.zeros(len(points_m))]))[:, :2]
        return join.place_cells(points_m)

    def _written(self, session: "SemanticCells", columns: dict[str, list], join: Join) -> State:
        """Write landmarks into a fresh memory, with which the session goes on."""
        merged = SemanticCells(self.config, follows=self.follows)
        dtypes = {c: session.known[c].dtype for c in columns}
        shape = {c: session.known[c].shape[1:] for c in columns}
        merged.known.replace(
            **{
                c: torch.tensor(v, dtype=dtypes[c]).reshape(-1, *shape[c])
                for c, v in columns.items()
            }
        )
        merged._index()
        slam = merged.slam
        if merged._rows:
            pointers = torch.stack([_pointer(self.config, *key) for key in merged._rows])
            slam.pointers = pointers.to(slam.pointers)
            merged._write()
        now = self._moved(np.array([session.pose[:2]]), join)[0]
        slam.time_s = session.slam.time_s.clone()
        slam.start(torch.tensor(now[None]))
        for name in session.now.kinds:
            setattr(merged.now, name, getattr(session.now, name))
        turn = join.rotation_rad if self.follows == "map" else join.cells_turn_rad
        merged.now.heading_rad = wrap_angle(session.now.heading_rad + turn)
        merged.now.told = -1
        return merged.state_dict()


def _same_nameless(one: SemanticCells, place_m: np.ndarray, free: int) -> tuple[int, int]:
    """Number that a nameless landmark gets in a merge, and the next that is free."""
    row, _ = one._nearest(place_m)
    return (int(one.known["number"][row]), free) if row >= 0 else (free, free + 1)


def _pointer(config: SemanticConfig, kind: int, number: int) -> Tensor:
    """Pointer of a landmark: random, of length 1, the same in every session."""
    draw = torch.Generator().manual_seed((config.seed * 3 + kind) * 1_000_003 + number)
    vector = torch.randn(config.key_features, generator=draw)
    return vector / vector.norm()


def _take_pointers(
    module: nn.Module, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    """Make room for as many pointers as a state has."""
    saved = state.get(f"{prefix}slam.pointers")
    if saved is not None:
        module.slam.pointers = module.slam.pointers.new_empty(saved.shape)
