"""Semantic cells of a brain: SSP-SLAM with a vocabulary of landmarks that grows."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Literal, Self, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.config import BrainConfig
from neuroslam.config.semantic import SemanticConfig
from neuroslam.errors import MapError, listed
from neuroslam.geometry import wrap_angle
from neuroslam.sensors.landmarks import KINDS, LandmarkWords
from neuroslam.sensors.markers import MarkerDetector
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.gaussian import encode_gaussian
from neuroslam.spiking.landmark_frames import from_frame, into_frame, shared_frames
from neuroslam.spiking.landmark_matching import match_landmarks
from neuroslam.spiking.semantic_joining import merge_landmarks
from neuroslam.spiking.sightings import (
    LEAST_SEEN,
    NAMED,
    NAMELESS,
    VIEW,
    LandmarkUpdate,
    Sightings,
)
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.spiking.vocabulary import (
    SemanticState,
    Vocabulary,
    WordTable,
    landmark_pointer,
)
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State, without_gradients
from neuroslam.state.pickling import Calls
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
from neuroslam.state.renumbering import Renumbering
from neuroslam.types import NO_TEMPLATE, Frame, Motion, Pose, PoseEstimate
from neuroslam.worlds.landmarks import LandmarkView

Follows = Literal["nothing", "map", "cells"]
"""What semantic cells are anchored to."""

CLEAR = 0.7
"""Least similarity of a recall with the position decoded from it, as a share of its strength, at
which it is the recall of one position."""

_KNOWN = 0.5  # strength of recall above which a landmark is known
_STEPS = 3  # Newton steps from the observed to the recalled position
_CONSENSUS = 3  # known landmarks in sight that can reject an outlier
_MOVED_M = 0.05  # movement of a landmark with its experience that rewrites the memory
_NEAR_M = 0.5  # nearer landmarks do not correct the heading


@register("semantic")
class SemanticCells(Population):
    r"""Learns the positions of landmarks as vectors, and corrects the robot's pose by known ones.

    One animal of :class:`~neuroslam.spiking.slam.SSPSLAM` with a vocabulary that grows: the pointer
    of a landmark follows from its kind and number, so it is the same in every session. Landmarks in
    sight are first identified, nameless ones by position; outliers among them are rejected.

    State: ``known`` (:class:`~neuroslam.spiking.vocabulary.Vocabulary`), ``words``
    (:class:`~neuroslam.spiking.vocabulary.WordTable`), ``slam``, and ``now``. Words do not change
    what the cells learn: the pointer of a landmark is its identity.

    Args:
        config: Of SSP-SLAM and of what a landmark is.
        heading_rad: Heading at the start.
        follows: ``nothing``: the cells lead; ``map``: landmarks are anchored to the experiences of
            a map that relaxes, and move with them; ``cells``: other cells estimate the pose and
            weigh landmarks themselves, so that these cells are not corrected by their memory.

    Example:
        >>> cells = SemanticCells(SemanticConfig())
        >>> door = Sightings.of(np.array([[7.0, 2.0, 0.0]]))
        >>> for _ in range(20):
        ...     update = cells.advance(Motion(0.0, 0.0, 0.1), door)
        >>> cells.landmarks()["place_m"].round(1).tolist() == [[2, 0]]
        True
    """

    merge_sections = ("semantic",)
    rank = 1
    compass = "uses"

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the semantic cells of a brain."""
        follows: Follows = "cells"
        if leader is cls:
            follows = "nothing"
        elif leader.relaxes_map:
            follows = "map"
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
        follows: Follows = "nothing",
    ) -> None:
        super().__init__()
        self.config = config
        self.follows: Follows = follows
        self.detector: MarkerDetector | None = None  # of markers in images
        self._update: LandmarkUpdate | None = None  # of the last frame
        self.known = Vocabulary()
        self.words = WordTable()
        pulls = config.model_copy(update={"gain": 0.0}) if follows == "cells" else config
        self.slam = SSPSLAM(pulls, landmark_pointer(config, NAMED, 0)[None])
        self.decoder = PositionDecoder(self.slam.space)
        self.now = SemanticState(heading_rad)
        self.slam.start(torch.zeros(1, 2))
        self.watch: Callable[[int, SSPStep], None] | None = (
            None  # a recorder's, called in each step
        )
        self.register_load_state_dict_pre_hook(_take_pointers)
        self.register_load_state_dict_post_hook(Calls("_index"))

    @property
    def n(self) -> int:
        """Number of confirmed landmarks."""
        return int(self.known.confirmed().sum())

    @property
    def pose(self) -> Pose:
        """Pose of the robot, as the cells estimate it."""
        x, y = self.slam.integrator.position_m[0].tolist()
        return Pose(x, y, self.now.heading_rad)

    def landmarks(self) -> dict[str, np.ndarray]:
        """Return the columns of the confirmed landmarks, and their names."""
        rows = self.known.confirmed()
        columns = {c: self.known[c][rows].numpy(force=True).copy() for c in self.known.columns}
        both = list(zip(columns["kind"].tolist(), columns["number"].tolist(), strict=True))
        return columns | {
            "name": np.array([self.words.name_of(*key) for key in both], dtype=str),
            "words": np.array([self.words.words_of(*key) for key in both], dtype=str),
        }

    def name_landmarks(self, table: Iterable[LandmarkWords]) -> None:
        """Give landmarks names and attributes, and define walls and regions.

        Args:
            table: Entries; they replace those of the same number or name. Landmarks that are not
                yet seen have their words from the first sighting on.

        Raises:
            SourceError: If an entry is invalid.
        """
        self.words.update(table)
        self._know(self.slam.pointers)

    def names(self) -> list[str]:
        """Return the names of all known landmarks, also of those that are not confirmed."""
        return [self.words.name_of(*key) for key in self.known.row_of]

    def _know(self, pointers: Tensor) -> None:
        """Set the pointers of the known landmarks, and with them their names."""
        names = self.names() or [self.words.name_of(NAMED, 0)]  # none: there is one spare pointer
        if len(names) != len(pointers):  # a damaged file, see faults
            names = [str(row) for row in range(len(pointers))]
        self.slam.know(pointers, names)

    def _index(self) -> None:
        """Update what follows from the columns of the tables."""
        self.known.index()
        self.words.index()
        self._know(self.slam.pointers)

    def continue_from(self, before: Population) -> None:
        """Keep the words of landmarks on a new map."""
        if isinstance(before, SemanticCells):
            self.name_landmarks(before.words.entries)

    def observe(self, frame: Frame) -> Sightings:
        """Return the landmarks in sight: those of the source, and markers in the image.

        Raises:
            BadFrame: If they are invalid.
        """
        tables = []
        if "given" in self.config.landmarks and frame.landmarks is not None:
            tables.append(frame.landmarks)
        if self.detector is not None and frame.image is not None:
            tables.append(self.detector(frame.image))
        return Sightings.of(*tables)

    def check(self, now: StepInput, observation: Observation, belief: Belief | None) -> None:
        """Raise if a frame takes the robot out of the space of the semantic pointers.

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
        """Learn the landmarks in sight, and return the correction by known ones.

        If relaxation of the map has moved the robot out of the space, there is no correction, and
        the next frame is refused.
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
        """Whether a known landmark has relocalised the robot in the last frame."""
        return self._update is not None and self._update.lost

    def belief(self, map_: LeadableMap) -> Belief:
        """Return the pose of the cells."""
        return Belief(self.pose)

    def decide(self, map_: LeadableMap, now: StepInput) -> Decision:
        """Go to the experience of the attended landmark; each landmark is an experience."""
        row = -1 if self._update is None else self._update.landmark
        experience, at = self.experience_of(row, map_.n)
        return Decision(*map_.visit(experience, self.pose, now.motion.dt_s, now.frame, at))

    @property
    def rates(self) -> np.ndarray:
        """Real, then imaginary part of each oscillator of the path integrator."""
        z = self.slam.integrator.z.flatten()
        return np.concatenate([z.real.numpy(force=True), z.imag.numpy(force=True)])

    def counts(self) -> dict[str, float]:
        """Return the number of confirmed landmarks."""
        return {"landmarks": self.n}

    def scalars(self) -> dict[str, float]:
        """Return the TensorBoard curves."""
        return {
            "semantic/landmarks": float(self.n),
            "semantic/contradicted_s": float(self.slam.contradicted_s[0]),
        }

    def tables(self) -> dict[str, str]:
        """Return ``landmarks.csv``: name,x_m,y_m,seen,first_frame,experience.

        A vocabulary with words adds the column ``words``, uncertain sightings the covariance of the
        position: ``var_x_m2,cov_xy_m2,var_y_m2``.
        """
        known = self.landmarks()
        columns = ("name", "place_m", "seen", "first_frame", "experience", "words")
        rows = list(zip(*(known[column].tolist() for column in columns), strict=True))
        lines = [f"{name},{x!r},{y!r},{n},{f},{e}" for name, (x, y), n, f, e, _ in rows]
        header = "name,x_m,y_m,seen,first_frame,experience"
        if self.words.entries:
            header += ",words"
            lines = [f"{line},{row[-1]}" for line, row in zip(lines, rows, strict=True)]
        spread = self.covariances()
        if spread is not None:
            header += ",var_x_m2,cov_xy_m2,var_y_m2"
            each = spread[self.known.confirmed().numpy()]
            lines = [
                f"{line},{xx!r},{xy!r},{yy!r}"
                for line, ((xx, xy), (_, yy)) in zip(lines, each.tolist(), strict=True)
            ]
        return {"landmarks.csv": "\n".join([header, *lines, ""])}

    def points_m(self) -> np.ndarray:
        """Return the positions of landmarks, ``(n, 2)``, without views."""
        known = self.landmarks()
        return known["place_m"][known["kind"] != VIEW]

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield missing pointers, and references to experiences that do not exist."""
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
        kinds = state.get("words.kind", np.empty(0, dtype=np.int64))
        rows = np.flatnonzero((kinds < 0) | (kinds >= len(KINDS)))
        if len(rows):
            most = len(KINDS) - 1
            yield f"words {listed(rows)}: kind {listed(kinds[rows])}, expected 0 to {most}"
        owed_s, step_s = float(state["now.owed_s"]), config.semantic.time_step_s
        if not -1e-3 * step_s <= owed_s <= 1.001 * step_s:  # of which a frame makes whole steps
            yield f"now.owed_s: {owed_s} s, expected 0 to {step_s} s, the time of a step"

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
            belief: Pose by a map or other cells that lead; ``None``: these cells lead.
            frame: Number of the frame.

        Raises:
            MapError: If the robot leaves the space; nothing has changed then.
        """
        now, before = self.now, self.pose
        if belief is None:
            x, y, heading = self._dead_reckoned(before, motion, compass_rad)
            length = motion.v_m_s * motion.dt_s
            step = length * math.cos(heading), length * math.sin(heading)
        else:
            x, y, heading = belief.pose
            step = x - before.x_m, y - before.y_m
        here = (x, y)
        self._stay_inside(here)
        now.heading_rad, now.frame = heading, frame
        if belief is not None and math.hypot(*step) > float(self.slam.space.length_scale_m.min()):
            self.slam.start(torch.tensor([here]))  # the leader has relocalised
            step = (0.0, 0.0)
        angle = seen.bearing_rad + heading
        vectors = np.column_stack([np.cos(angle), np.sin(angle)]) * seen.distance_m[:, None]
        places = np.array(here) + vectors
        rows, fresh = self._identify(seen, places, belief)
        good = self._inliers(rows, fresh, places)
        rows, vectors, kind = rows[good], vectors[good], seen.kind[good]
        attended, strength, gate, lost = self._steps(motion.dt_s, step, rows, vectors)
        if attended < 0:
            now.told = -1
            return LandmarkUpdate((0.0, 0.0), 0.0, None, 0.0, -1, False, False)
        vector = vectors[rows == attended][0]
        if strength > _KNOWN:
            self._note_place(attended, belief, np.array(here) + vector)
        place: tuple[float, float] | None = None
        if bool(self.slam.familiar[0]) and (now.told != attended or lost):
            now.told = attended
            x, y = (self.known["place_m"][attended].numpy() - vector).tolist()
            place = x, y
        lost = lost and place is not None and self._is_inside(place)
        if lost and place is not None:  # landmarks contradicted for long: kidnapped, or much drift
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
        """Move landmarks with the experiences they are anchored to, after relaxation of the map.

        Args:
            poses: Poses of all experiences, ``(n, 3)``.

        Returns:
            Whether a landmark moved so far that the memory was rewritten.
        """
        anchor = self.known["experience"].numpy()
        rows = np.flatnonzero(anchor >= 0)
        if not len(rows):
            return False
        place = self.known["place_m"].numpy()
        there = from_frame(poses[anchor[rows]], self.known["offset_m"].numpy()[rows])
        if np.abs(there - place[rows]).max() < _MOVED_M:
            return False
        certain = self.covariances()
        self.known["place_m"][rows] = torch.from_numpy(there)
        self.write_memory(certain)
        return True

    def covariances(self) -> np.ndarray | None:
        """Return the covariances of the recalled positions; see :meth:`SSPSLAM.uncertainty`.

        Returns:
            In square metres, ``(n, 2, 2)``, 0 where the recall is weak; ``None`` if sightings are
            exact.
        """
        z = self.slam.space.to_fourier(self.slam.map.read(self.slam.pointers)[0])
        found = self.slam.uncertainty(z[: len(self.known)])
        if found is None:
            return None
        known = (found.strength > _KNOWN)[:, None, None]
        return torch.where(known, found.covariance_m2, 0.0).double().numpy(force=True)

    def write_memory(self, covariance_m2: np.ndarray | None = None) -> None:
        """Rewrite the memory so that every landmark recalls its position in ``known``.

        Args:
            covariance_m2: Of the positions, ``(n, 2, 2)``; ``None``: they are exact.
        """
        slam = self.slam
        at = self.known["place_m"].to(slam.pointers)
        if covariance_m2 is None:
            places = slam.space.encode(at).detach()
        else:
            spread = torch.from_numpy(covariance_m2).to(at)
            places = slam.space.from_fourier(encode_gaussian(slam.space, at, spread)).detach()
        slam.map.write(slam.pointers, places)
        if slam.places is not None:
            slam.places.write(places, slam.pointers)

    def experience_of(self, row: int, n: int) -> tuple[int, Pose | None]:
        """Return the experience that a landmark is, and its pose, where these cells lead the map.

        Args:
            row: Row of the landmark, or -1.
            n: Number of experiences; a new landmark becomes the next one.
        """
        if row < 0 or int(self.known["seen"][row]) < LEAST_SEEN:
            return -1, None
        if int(self.known["experience"][row]) < 0:
            self.known["experience"][row] = n
        x, y = self.known["place_m"][row].tolist()
        return int(self.known["experience"][row]), Pose(x, y, self.now.heading_rad)

    def relocalise(self, place_m: tuple[float, float]) -> None:
        """Set the position of the robot; its memory stays."""
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

    def _identify(
        self, seen: Sightings, places_m: np.ndarray, belief: Belief | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Identify each landmark in sight: its row, -1 for none, and whether it is new."""
        rows = np.full(len(seen.kind), -1)
        fresh = np.zeros(len(rows), dtype=bool)
        for i, (kind, number) in enumerate(zip(seen.kind.tolist(), seen.number.tolist(),
                                               strict=True)):  # fmt: skip
            if kind == NAMELESS:
                rows[i], number = self.known.nearest_nameless(places_m[i], self.config.same_m)
            else:
                rows[i] = self.known.row_of.get((kind, number), -1)
            if rows[i] < 0 and number >= 0:
                rows[i], fresh[i] = self._add(kind, number, places_m[i], belief), True
            if rows[i] >= 0:
                self.known["seen"][rows[i]] += 1
        return rows, fresh

    def _add(self, kind: int, number: int, place_m: np.ndarray, belief: Belief | None) -> int:
        """Add a landmark to the vocabulary; return its row."""
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
        self.known.row_of[kind, number] = row
        pointer = landmark_pointer(self.config, kind, number)[None].to(self.slam.pointers)
        self._know(torch.cat([self.slam.pointers[:row], pointer]))
        return row

    def _inliers(self, rows: np.ndarray, fresh: np.ndarray, places_m: np.ndarray) -> np.ndarray:
        """Return which landmarks in sight are inliers."""
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
        """Run SSP-SLAM for the time of a frame.

        Returns:
            Of the last step: attended landmark or -1, strength of its recall, opening of the gate,
            and whether the robot is lost.
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
        result = slam.run(velocity.expand(steps, 1, 2), view, self.watch)
        recall, gate, lost, attended = (
            part[-1, 0] for part in (result.recall, result.gate, result.lost, result.attended)
        )
        known = bool(lost) and bool(slam.familiar[0])
        return int(attended), float(recall), float(gate), known

    def _note_place(self, row: int, belief: Belief | None, seen_m: np.ndarray) -> None:
        """Decode the recalled position of a landmark into ``known``."""
        recalled = torch.view_as_complex(self.slam.recalled)
        start = self.known["place_m"][row][None].to(recalled.real)
        place = self.decoder.track(recalled, start)
        clear = CLEAR * float(self.slam.wholeness(recalled))
        if float(self.decoder.similarity(recalled, place)) < clear:  # decoded at a side lobe?
            again = torch.from_numpy(seen_m)[None].to(start)
            for _ in range(_STEPS):
                again = self.decoder.track(recalled, again)
            if float(self.decoder.similarity(recalled, again)) >= clear:
                place = again
        place = place[0].double()
        anchor = int(self.known["experience"][row])
        if anchor >= 0 and self.follows == "map":
            at = cast(Belief, belief).poses[anchor]
            self.known["offset_m"][row] = torch.from_numpy(into_frame(at, place.numpy()))
        self.known["place_m"][row] = place

    def _turn(self, dt_s: float, rows: np.ndarray, vectors: np.ndarray, kind: np.ndarray) -> float:
        r"""Correct an integrated heading by the bearings of known landmarks.

        .. math:: \theta \leftarrow \theta - \kappa\,\Delta t\;
                  \mathrm{mean}_i\,\angle\bigl(d_i,\, m_i - x\bigr)

        with :math:`d_i` the observed vector and :math:`m_i` the recalled position of the landmark.
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

    def renumber(self, change: Renumbering) -> None:
        """Follow the ids of the experiences that landmarks are anchored to."""
        anchor = self.known["experience"].numpy()
        rows = np.flatnonzero(anchor >= 0)
        moved, offset = change.relative[anchor[rows]], self.known["offset_m"].numpy()
        offset[rows] = from_frame(moved, offset[rows])
        anchor[rows] = change.experiences[anchor[rows]]

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Merge the landmarks of two sessions; see :func:`~.semantic_joining.merge_landmarks`."""
        return merge_landmarks(
            lambda: SemanticCells(self.config, follows=self.follows), loaded, partial, join
        )

    def frames(self, loaded: State, partial: State, join: Join) -> tuple[Pose, Pose] | None:
        """Align the frames of two sessions by the named landmarks that both know."""
        if self.follows != "nothing":
            return None
        return shared_frames(loaded, partial, same_m=self.config.same_m)

    def match(
        self, loaded: Population, maps: tuple[np.ndarray, np.ndarray], config: BrainConfig
    ) -> tuple[Match | None, str]:
        """Find the alignment of two maps by the named landmarks of both sessions."""
        if not isinstance(loaded, SemanticCells):
            raise TypeError(
                f"SemanticCells: cannot be matched with {type(loaded).__name__}; "
                "expected SemanticCells"
            )
        states = loaded.state_dict(), self.state_dict()
        known = loaded.landmarks(), self.landmarks()
        return match_landmarks(states, known, maps, config)

    def moved(self, points_m: np.ndarray, join: Join) -> np.ndarray:
        """Move positions of the partial session, ``(n, 2)``, into the loaded frame."""
        if self.follows == "map":
            return join.place(np.column_stack([points_m, np.zeros(len(points_m))]))[:, :2]
        return join.place_cells(points_m)


def _take_pointers(
    cells: SemanticCells, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    """Resize the pointers to those of a saved state."""
    saved = state.get(f"{prefix}slam.pointers")
    if saved is not None:
        spare = [str(row) for row in range(len(saved))]  # named when all is loaded
        cells.slam.know(cells.slam.pointers.new_empty(saved.shape), spare)
