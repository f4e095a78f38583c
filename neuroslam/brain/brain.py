"""The brain: odometry, view, pose cells and map, composed; one frame in, one result out."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from neuroslam.brain.continuity import Continuity
from neuroslam.brain.recognition import Recognition, StoredViews
from neuroslam.cells.boundary import checked_walls
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame, ConfigError, counted
from neuroslam.geometry import TWO_PI, compose, wrap_angle
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import n_places
from neuroslam.merging.limits import WINDOW, elsewhere, tolerance
from neuroslam.merging.match import shared_history
from neuroslam.merging.merge import Match, differing, merge
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.sensors.frames import (
    check_instant,
    check_picture,
    checked_number,
    checked_odometry,
)
from neuroslam.sensors.markers import MarkerDetector
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.sightings import VIEW, Guide, Sightings, Told
from neuroslam.state.population import Population, Running, State
from neuroslam.state.sessions import Session, SessionLog, session_id
from neuroslam.state.tables import Scalars
from neuroslam.types import (
    NO_EXPERIENCE,
    NO_TEMPLATE,
    Frame,
    Motion,
    Pose,
    PoseEstimate,
    StepResult,
    Velocity,
    ViewMatch,
)
from neuroslam.view.features import Encoder, view_encoder
from neuroslam.view.templates import LocalViewCells

_COMPASS_S = 2.0  # over which the noise of a compass is averaged
BLIND = ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)


class Clock(Scalars, Running):
    """Frame and time the brain is at."""


class Compass(Scalars, Running):
    """Heading of the robot by compass and turns together, as the map has taken it over."""


class Sensed(NamedTuple):
    """What a brain finds in a frame: the view, encoded; walls, ``(n, 2)``; landmarks."""

    view: np.ndarray | None
    walls: np.ndarray | None
    landmarks: Sightings


class NavigationBrain(nn.Module):
    """A stream of frames becomes a map of places, by any set of populations side by side.

    Each stage is a module that can be used alone: ``odometry``, ``view``, ``pose_cells`` and
    ``map`` (RatSLAM); ``navigation``, boundary, grid and place cells (SLRB), and ``semantic``,
    landmarks and their places (SSP-SLAM), where ``config.cells`` names them. Where there are
    several, they have one belief of where the robot is: self-motion and walls move it, landmarks
    and views correct it, and each is told of what the others found. ``state_dict`` holds
    everything: a brain that is saved, loaded and goes on is bit-equal to one that never stopped.

    Args:
        config: Every parameter; the defaults suit a forward camera on a small robot.
        features: Network that makes views, where ``config.view.features`` is ``"module"``; see
            :class:`~neuroslam.view.features.FeatureEncoder`.

    Example:
        >>> from neuroslam.types import Frame, Velocity
        >>> brain = NavigationBrain(BrainConfig())
        >>> picture = torch.arange(160 * 120).reshape(120, 160).to(torch.uint8).numpy()
        >>> brain(Frame(0, 0.0, picture, Velocity(0.5, 0.0))).action
        'create'
    """

    def __init__(
        self, config: BrainConfig | None = None, *, features: nn.Module | Encoder | None = None
    ) -> None:
        super().__init__()
        self.config = config or BrainConfig()
        self._encoder = view_encoder(self.config.view, features)
        self.about = ("", "", "")  # source, preset and date of the next session
        self._detects = self.config.sessions.carried == "detect"
        self.clock = Clock(frame=-1, time_s=0.0, frames_seen=0, after_gap_s=-math.inf)
        self.stored = nn.ModuleList()
        self._begin()
        self.register_load_state_dict_pre_hook(_make_stored)
        self.register_load_state_dict_post_hook(lambda module, _: module._changed())

    def _begin(self) -> None:
        """Start with an empty map."""
        config, cells = self.config, self.config.pose_cells
        self.odometry = VisualOdometry(config.odometry)
        self.view = LocalViewCells(config.view, self._encoder)
        self.pose_cells = PoseCellNetwork(cells)
        self.map = ExperienceMap(
            config.map, (cells.n_xy, cells.n_xy, cells.n_theta), cells.create_threshold_cells
        )
        if config.has("place"):
            self.navigation = NavigationCells(config)
        if config.has("semantic"):
            heading = math.radians(config.map.initial_heading_deg)
            follows = "map" if config.has("pose") else "cells" if config.has("place") else "nothing"
            self.semantic = SemanticCells(config.semantic, heading, follows)
        self.compass = Compass(heading_rad=0.0, known=0)
        self.sessions = SessionLog()
        self.recognition = Recognition()
        self.continuity = Continuity(config)
        self._changed()

    def _changed(self) -> None:
        """Forget what follows from the stored maps."""
        self._stored_views: StoredViews | None = None

    def populations(self) -> dict[str, Population]:
        """Return the parts that its state is made of, by name."""
        return {n: part for n, part in self.named_children() if isinstance(part, Population)}

    @torch.inference_mode()
    def forward(self, frame: Frame) -> StepResult:
        """Take in one frame.

        Raises:
            BadFrame: If the frame's time does not follow the last one's, or it has nothing to
                tell motion from. The brain knows no more then than before, and can go on with
                another frame; after a gap the one after next is taken, if it follows.
        """
        try:
            dt_s = self._elapsed(frame)
            sensed = self._sense(frame)
            velocity = self._velocity(frame, dt_s)
        except BadFrame as fault:
            raise BadFrame(f"frame {frame.index}: {fault}") from None
        seen = sensed.view
        gap = dt_s > self.config.max_gap_s
        carried = seen is not None and self.continuity.breaks(seen) and self._detects
        if gap or carried:
            self.start_new_map("gap" if gap else "carried")
            if gap or frame.velocity is None or self.config.odometry.use == "visual":
                velocity = Velocity(0.0, 0.0)  # pictures of two places say nothing of motion
            dt_s = 1.0 / self.config.frame_rate_hz if gap else dt_s
        motion = Motion(*velocity, dt_s)
        self.continuity.moved(velocity, dt_s)
        view = BLIND if seen is None else self.view.recognise(seen)
        if not self.sessions.sessions:
            self._name_session(frame, sensed)
        place, lost, turn = NO_EXPERIENCE, False, 0.0
        if self.config.has("place"):
            turn = self.navigation.heading_error_rad
            where = self.navigation.live(motion, frame.heading_rad, sensed.walls)
            turn -= self.navigation.heading_error_rad
            place, lost = NO_EXPERIENCE if where.lost else int(where.place), bool(where.lost)
        if self.config.has("pose"):
            turn += self._turn_by_compass(frame.heading_rad, motion)
            cells = self.pose_cells(motion, view)
            elsewhere = self.config.has("place") and self.navigation.contradicts(view)
            action, experience = self.map(motion, view, cells, frame.index, carried=elsewhere)
            if self.config.has("place"):
                self._correct(*where.correction_m.tolist(), turn, self.navigation.pose.theta_rad)
                self.navigation.see(view)
            else:
                self._correct(0.0, 0.0, turn, 0.0)
        if self.config.has("semantic"):
            told = self._meet_landmarks(frame, motion, sensed.landmarks, view)
            lost = lost or told.lost
        if not self.config.has("pose"):
            at = None
            if self.config.has("place"):
                pose = self.navigation.pose
            else:
                pose = self.semantic.pose
                place, at = self.semantic.place_of(told.landmark, self.map.n)
            cells = PoseEstimate(pose.x_m, pose.y_m, 0.0)
            action, experience = self.map.visit(place, pose, dt_s, frame.index, at)
        self.clock.frame, self.clock.time_s = frame.index, float(frame.time_s)
        self.clock.frames_seen += 1
        self.clock.after_gap_s = -math.inf
        self.sessions.now.frames += 1
        if seen is not None and action in ("create", "link") and self._recognise(frame, seen, view):
            view = view._replace(template=self.view.last.template, is_new=False)
            cells, action, experience = self.pose_cells.estimate, "set", self.map.current
        return StepResult(
            frame=frame.index,
            time_s=frame.time_s,
            motion=motion,
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

    def _sense(self, frame: Frame) -> Sensed:
        """Find in a frame what the brain has cells for; checked, and nothing changed by it."""
        config, image = self.config, frame.image
        walls = view = None
        landmarks = []
        compass = config.cells != ("pose",) and frame.heading_rad is not None
        if compass:
            checked_number(frame.heading_rad, "heading", "rad")
        if image is not None:
            check_picture(image)
        if config.has("place") and frame.walls is not None:
            walls = checked_walls(frame.walls)
        elif config.has("place") and frame.ranges is not None:
            walls = walls_in_scan(frame.ranges, config.boundary_cells.reach_m)
        if config.has("semantic"):
            if "given" in config.semantic.landmarks and frame.landmarks is not None:
                landmarks.append(frame.landmarks)
            if "markers" in config.semantic.landmarks and image is not None:
                landmarks.append(self._markers(image))
        if config.has("pose") and image is not None:
            view = self.view.look(image)
        return Sensed(view, walls, Sightings.of(*landmarks))

    @cached_property
    def _markers(self) -> MarkerDetector:
        c = self.config
        return MarkerDetector(
            c.semantic.markers, c.semantic.marker_size_m, c.odometry.fov_deg, c.view.panoramic
        )

    def _turn_by_compass(self, heading_rad: float | None, motion: Motion) -> float:
        """By how much the map turns, so that its heading follows a compass within seconds.

        Pose cells and map alone do without, as RatSLAM does.
        """
        now, cells = self.compass, self.config.cells
        if cells == ("pose",) or (heading_rad is None and not now.known):
            return 0.0
        now.heading_rad += motion.w_rad_s * motion.dt_s
        if heading_rad is None:
            return 0.0
        if not now.known:
            now.heading_rad, now.known = heading_rad, 1
        off = wrap_angle(heading_rad - now.heading_rad)
        turn = off * (1.0 - math.exp(-motion.dt_s / _COMPASS_S))
        now.heading_rad += turn
        return turn

    def _meet_landmarks(
        self, frame: Frame, motion: Motion, landmarks: Sightings, view: ViewMatch
    ) -> Told:
        """Learn the landmarks in sight; let map and other cells follow what known ones correct."""
        if "views" in self.config.semantic.landmarks and view.template != NO_TEMPLATE:
            landmarks = landmarks.with_view(view.template)
        guide = None
        if self.config.has("pose"):
            poses = self.map.experiences["pose"].numpy(force=True)
            self.semantic.follow_map(poses)
            guide = Guide(self.map.pose, 0.0, self.map.current, poses)
        elif self.config.has("place"):
            guide = Guide(self.navigation.pose, self.navigation.variance_m2)
        told = self.semantic.live(
            motion, landmarks, compass_rad=frame.heading_rad, guide=guide, frame=frame.index
        )
        if self.config.has("pose"):
            (x, y), facing = told.correction_m, self.map.pose.theta_rad
            self._correct(x, y, told.turn_rad, facing)
            if told.lost and self.config.has("place"):
                here = self.navigation.pose
                x, y = _rotated(x, y, here.theta_rad - facing)
                moved = Pose(here.x_m + x, here.y_m + y, here.theta_rad)
                self.navigation.go_to(moved, self.config.semantic.sigma_m)
        elif self.config.has("place") and told.place_m is not None:
            sigma = self.config.semantic.sigma_m
            if told.lost:  # it was carried there
                heading = self.navigation.pose.theta_rad
                self.navigation.go_to(Pose(*told.place_m, heading), sigma)
            else:
                self.navigation.hear(told.place_m, sigma, told.variance_m2)
        return told

    def _correct(self, x_m: float, y_m: float, turn_rad: float, heading_rad: float) -> None:
        """Let pose cells and map follow a correction, in the frame of one who has that heading."""
        if x_m == y_m == turn_rad == 0.0:
            return
        cells = self.config.pose_cells
        facing = TWO_PI * self.pose_cells.estimate.theta / cells.n_theta
        self.map.nudge(*_rotated(x_m, y_m, self.map.pose.theta_rad - heading_rad), turn_rad)
        self.pose_cells.nudge(
            *(way / cells.cell_size_m for way in _rotated(x_m, y_m, facing - heading_rad)),
            turn_rad * cells.n_theta / TWO_PI,
        )

    def store(self, other: "NavigationBrain") -> None:
        """Remember the maps of another brain; when one is recognised, it is joined to this map.

        Args:
            other: It is not altered; the maps that it has stored itself are taken too.

        Raises:
            ConfigError: If views or pose cells of the two were made with different configs, or
                views by another network.
        """
        self.view.load_network()
        apart = differing(self, other)
        if apart:
            raise ConfigError(
                f"a stored map was made with another config: {'; '.join(apart)}; "
                "run with the stored map's config"
            )
        for one in (other, *other.stored):
            if one.map.n:
                self._store_one(one)
        self._changed()

    def _store_one(self, one: "NavigationBrain") -> None:
        copy = NavigationBrain(one.config)
        copy.take(one.state_dict(), [])
        for i, before in enumerate(self.stored):
            shared = shared_history(before, copy)
            merged = merge(before, copy, shared.match)[0] if shared and shared.match else None
            if merged is not None:  # what became of one map in two sessions
                self.stored[i] = merged
                return
        self.stored.append(copy)
        self.recognition.store()

    def start_new_map(self, why: str = "carried") -> None:
        """Go on with an empty map, for the robot is no longer where it was.

        The map so far is stored; it is joined again when a place of it is recognised.

        Args:
            why: ``carried``, or ``gap``; kept with the new session.
        """
        if not self.map.n:
            return
        before, clock, tally = self.sessions.now, self.clock, self.recognition.tally
        senses = self.odometry, self.continuity  # they go on: this frame is the next one's before
        kept = NavigationBrain(self.config)
        kept.take({k: v for k, v in self.state_dict().items() if k[:7] != "stored."}, [])
        self.stored.append(kept)
        self._begin()
        self.odometry, self.continuity = senses
        self.view.go_on_from(kept.view)
        for alike, agreed in zip(tally["alike"].tolist(), tally["agreed"].tolist(), strict=True):
            self.recognition.tally.append(alike=alike, agreed=agreed)
        self.recognition.store()
        session = Session(
            session_id(before.id, clock.frames_seen, why),
            before.source,
            before.preset,
            before.recorded,
            clock.frame + 1,
            clock.time_s,
            began=why,
            continues=before.id,
        )
        self._open(session)

    def take(self, state: State, stored: Sequence["NavigationBrain"]) -> None:
        """Go on with another state, and with these stored maps."""
        self._begin()
        self.stored = nn.ModuleList(stored)
        own = {name: value for name, value in state.items() if not name.startswith("stored.")}
        for i, one in enumerate(stored):
            own |= {f"stored.{i}.{name}": value for name, value in one.state_dict().items()}
        self.load_state_dict(own)
        tally = self.recognition.tally
        rows = {name: tally[name][: len(stored)] for name in tally.columns}
        tally.replace(**rows)
        while tally.n < len(stored):
            tally.append(alike=0, agreed=0)

    def _name_session(self, frame: Frame, sensed: Sensed) -> None:
        """Open a session, or give the one that was announced its id, by what it begins with."""
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
                    *((frame.heading_rad, sensed.walls) if self.config.has("place") else ()),
                    *(sensed.landmarks if self.config.has("semantic") else ()),
                ),
                *self.about,
                frame.index,
                float(frame.time_s),
            )
        )

    def _open(self, session: Session) -> None:
        self.sessions.sessions.append(session)
        self.map.state.session = session.id

    def _recognise(self, frame: Frame, encoded: np.ndarray, view: ViewMatch) -> bool:
        """Join a stored map if this place is surely one of it."""
        config, recognition = self.config.sessions, self.recognition
        if not len(self.stored):
            return False
        recognition.arrive(WINDOW * config.confirm)
        if self._stored_views is None:
            self._stored_views = StoredViews([one.view for one in self.stored])
        where, seen = self._stored_views.search(encoded)
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
        near = templates[~elsewhere(loaded, int(agreed.loaded[-1]), limits)]
        match = Match(
            loaded=int(agreed.loaded[-1]),
            partial=self.map.current,
            turn_rad=float(agreed.turn_rad[-1]),
            error=seen.error,
            runner_up=self._stored_views.runner_up(encoded, where, near),
            others=agreed.pick(slice(-1)),
        )
        return self._join(where, match, frame)

    def _join(self, where: int, match: Match, frame: Frame) -> bool:
        """Join stored map ``where``, and then those that share a session with it."""
        rest = [one for i, one in enumerate(self.stored) if i != where]
        loaded, everything, tally = self.stored[where], self.stored, self.recognition.tally
        self.stored = nn.ModuleList()  # what else is stored is neither copied nor looked at
        merged, report = merge(loaded, self, match)
        self.stored = everything
        report.at_frame = frame.index
        if merged is None:
            self.recognition.forget()
            self.sessions.refusals.append(report.to_dict())
            return False
        merged.sessions.merges[-1] = report.to_dict()
        for name, part in merged.populations().items():
            setattr(self, name, part)
        self.view.encoder = self._encoder
        self.stored = nn.ModuleList(rest)
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

    def not_joined(self) -> list[dict[str, object]]:
        """Say of each stored map how much of it was recognised, for the report of a run."""
        tally, needed = self.recognition.tally, self.config.sessions.confirm
        return [
            {
                "sessions": [session.name for session in one.sessions.sessions],
                "experiences": one.map.n,
                "places_that_look_alike": alike,
                "places_that_agree": agreed,
                "reason": "maps without views are laid on each other when they are finished: "
                "neuroslam merge"
                if not self.config.has("pose")
                else f"{counted(alike, 'place')} looked like one of it, {agreed} at most agreed on "
                f"how the maps lie; {needed} must",
            }
            for one, alike, agreed in zip(
                self.stored, tally["alike"].tolist(), tally["agreed"].tolist(), strict=True
            )
        ]

    @property
    def landmarks_m(self) -> np.ndarray | None:
        """Where landmarks are on the map, ``(n, 2)``, views left out; ``None``: it has no cells."""
        if not self.config.has("semantic"):
            return None
        known = self.semantic.landmarks()
        return known["place_m"][known["kind"] != VIEW]

    def place(self, experience: int, offset: Pose) -> Pose:
        """Return where a robot is, on the map as it is now, that was at ``offset`` from a place.

        Args:
            experience: Id, or -1 for the origin before the first experience.
            offset: Pose relative to that experience, as ``map.offset`` gave it at the time.
        """
        if experience < 0:
            return offset
        return compose(Pose(*self.map.experiences["pose"][experience].tolist()), offset)

    def _elapsed(self, frame: Frame) -> float:
        check_instant(frame)
        if not self.clock.frames_seen:
            return 1.0 / self.config.frame_rate_hz
        dt_s = frame.time_s - self.clock.time_s
        if not dt_s > 0.0:  # NaN too
            raise BadFrame(
                f"time {frame.time_s:g} s does not follow {self.clock.time_s:g} s "
                f"of frame {self.clock.frame}; times must rise"
            )
        if dt_s > self.config.max_gap_s and self.config.sessions.after_gap == "new_map":
            return float(dt_s)
        if dt_s > self.config.max_gap_s:
            since_s = frame.time_s - self.clock.after_gap_s
            if 0.0 < since_s <= self.config.max_gap_s:
                return float(since_s)  # the gap is real: what was missed in it stays unknown
            self.clock.after_gap_s = float(frame.time_s)
            raise BadFrame(
                f"{dt_s:g} s after frame {self.clock.frame}, more than "
                f"max_gap_s = {self.config.max_gap_s:g}; raise it if the gap is real"
            )
        return float(dt_s)

    def _velocity(self, frame: Frame, dt_s: float) -> Velocity:
        use = self.config.odometry.use
        if use != "visual" and frame.velocity is not None:
            return checked_odometry(frame.velocity)
        if use == "given" or frame.image is None:
            raise BadFrame(
                "no odometry in the source"
                + ("; set odometry.use to 'visual'" if use == "given" else " and no image")
            )
        return self.odometry(frame.image, dt_s)


def _rotated(x: float, y: float, by_rad: float) -> tuple[float, float]:
    c, s = math.cos(by_rad), math.sin(by_rad)
    return c * x - s * y, s * x + c * y


def _make_stored(module: NavigationBrain, state: State, prefix: str, *_unused: object) -> None:
    """Make as many stored maps as a state has."""
    inside = f"{prefix}stored."
    numbers = {int(key[len(inside) :].split(".")[0]) for key in state if key.startswith(inside)}
    if len(numbers) != len(module.stored):
        module.stored = nn.ModuleList(NavigationBrain(module.config) for _ in numbers)
