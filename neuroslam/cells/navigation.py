"""SLRB: boundary, grid and place cells that localise an animal by self-motion and walls."""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Self, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.boundary import BoundaryCells, check_motion, check_walls, checked_walls
from neuroslam.cells.boundary_sheet import BoundarySheet
from neuroslam.cells.familiarity import SURE, Familiarity
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.joining import join_navigation, navigation_faults, view_frames
from neuroslam.cells.navigation_state import NavigationEstimate, NavigationState
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells
from neuroslam.cells.wall_matching import match_walls, outline_of
from neuroslam.cells.walls import WallMemory, walls_around
from neuroslam.compiled import runs_compiled
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.geometry import wrap_angle
from neuroslam.sensors.frames import checked_number
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import Arrays, State, without_gradients
from neuroslam.state.population import (
    Belief,
    Correction,
    Decision,
    LeadableMap,
    Observation,
    Population,
    StepInput,
)
from neuroslam.state.registry import leading_class, register
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable
from neuroslam.types import (
    NO_EXPERIENCE,
    NO_TEMPLATE,
    Frame,
    Motion,
    Pose,
    PoseEstimate,
    ViewMatch,
)

_POSES = 512  # at which rates are computed at once

FAMILIARITY_PERIOD_S = 0.5
"""Time between two comparisons of the walls with those known at the place cell."""


@register("place")
class NavigationCells(Population):
    """Boundary, grid and place cells of an animal that senses its motion and the walls around.

    Self-motion advances the phases of oscillators, which drive the grid cells; walls correct the
    phases of all modules by one displacement; place cells compete for the pattern of the grid
    cells. A lost animal continues by path integration, and does not learn until it relocalises.

    Steps run in inference mode: gradients flow through the parts, not through the whole. All
    animals of a batch are corrected, and their place cells compete, at the same instants; so an
    animal of a batch is not bit-equal to the same animal alone.

    Args:
        config: Of the brain; the sections ``boundary_cells``, ``grid_cells``, ``place_cells`` and
            ``wall_memory`` are used.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> cells = NavigationCells(BrainConfig())
        >>> none = torch.empty(0)
        >>> here = cells(torch.tensor(0.2), torch.tensor(0.0), 0.5, none, none)
        >>> [round(x, 6) for x in here.position_m.tolist()], here.place.item()
        ([0.1, 0.0], 0)
    """

    __call__: Callable[..., NavigationEstimate]

    name = "navigation"
    merge_sections = ("boundary_cells", "grid_cells", "place_cells")
    rank = 2
    compass = "uses"

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the navigation cells of a brain."""
        return cls(config)

    def __init__(self, config: BrainConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self._estimate: NavigationEstimate | None = None  # of the last frame
        self.batch = batch
        self.boundary = BoundaryCells(config.boundary_cells, batch)
        cells_sense = config.wall_memory.senses == "boundary_cells"
        self.sheet = BoundarySheet(config.boundary_cells) if cells_sense else None
        self.oscillators = VelocityOscillators(config.grid_cells, batch)
        self.grid = LAHNGridCells(config.grid_cells, batch)
        self.place = CompetitiveHebbianPlaceCells(
            config.place_cells, self.grid.rates.shape[-2:].numel(), batch
        )
        self.walls = WallMemory(config.wall_memory, batch)
        self.familiarity = Familiarity(
            config.boundary_cells, config.wall_memory.lost_after_s, batch
        )
        self._senses = cells_sense
        self.now = NavigationState(config.map.initial_heading_deg)
        # Pose at which each view was learnt; ``sure`` is 0 if the animal was lost.
        self.seen = GrowingTable(
            {name: ((), torch.float64) for name in ("x_m", "y_m", "heading_rad", "sure")}
        )

    @without_gradients
    def forward(
        self,
        speed_m_s: Tensor,
        heading_rad: Tensor,
        dt_s: float,
        wall_m: Tensor,
        wall_bearing_rad: Tensor,
        *,
        compass: bool = True,
        read: bool = False,
        sensed: bool = True,
    ) -> NavigationEstimate:
        """Advance by one step of motion, and correct by the walls at its end.

        Args:
            speed_m_s: Measured speed, ``([batch])``.
            heading_rad: Measured heading in the world, ``([batch])``.
            dt_s: Duration of the step.
            wall_m: Distance to the foot of the perpendicular on each wall,
                ``([batch,] n_walls)``, nearest first; ``inf`` where there is none.
            wall_bearing_rad: Its bearing relative to the heading, the same shape.
            compass: Whether the heading is measured; else it is integrated from turn rates.
            read: Whether the walls were read from the sheet of boundary cells already.
            sensed: Whether walls were looked for; if not, none is no evidence that none is there.

        Raises:
            BadFrame: If a number is not finite or a distance negative; nothing has changed then.
        """
        if wall_m.shape != wall_bearing_rad.shape:
            check_walls(wall_m, wall_bearing_rad)
        _check_duration(dt_s)
        if self._compiles() and runs_compiled(wall_m):
            felt_m = np.ascontiguousarray(wall_m.numpy(), np.float64)
            felt_rad = np.ascontiguousarray(wall_bearing_rad.numpy(), np.float64)
            speed, heading = float(speed_m_s), float(heading_rad)
            return self._step(speed, heading, dt_s, felt_m, felt_rad, compass, read, sensed)
        bearing = wall_bearing_rad + heading_rad.unsqueeze(-1)
        total = float((speed_m_s + heading_rad + bearing.sum(-1)).sum())
        nearest = float(wall_m.min()) if wall_m.numel() else math.inf
        if not math.isfinite(total) or not nearest >= 0.0:
            check_motion(speed_m_s, heading_rad)
            check_walls(wall_m, wall_bearing_rad)
        memory, oscillators, now = self.walls, self.oscillators, self.now
        lost = self.familiarity.lost
        learns = ~lost if now.someone_lost else None
        if nearest <= self.config.boundary_cells.reach_m:
            self.boundary.respond(wall_m, bearing, dt_s)
        else:
            self.boundary.rest()
        step = memory.move(speed_m_s, heading_rad, dt_s)
        correction = torch.zeros_like(step)
        if self.sheet is not None and not read and nearest < math.inf and self._uses_walls(dt_s):
            wall_m, bearing, _ = self.sheet.read(self.sheet(wall_m, bearing))
            nearest = float(wall_m.min()) if wall_m.numel() else math.inf
        if nearest < math.inf and memory.is_due and self.config.wall_memory.corrects:
            believed = oscillators.decode() + step
            correction = memory.update_from_walls(
                believed, wall_m, bearing, compass=compass, learns=learns
            )
            step = step + correction
        grid = self.grid(oscillators.shift(step))
        place = self.place(grid.flatten(-2), oscillators.position_m, dt_s, learns=learns)
        now.since_s = _since(now.since_s + dt_s, sensed)
        if sensed and now.since_s >= FAMILIARITY_PERIOD_S:
            x, felt_m, felt_rad = oscillators.position_m, wall_m, bearing - memory.errors[:, 1:]
            if self.batch is None:
                x, felt_m, felt_rad = x[None], felt_m[None], felt_rad.reshape(1, -1)
            sure_m = SURE * self.config.boundary_cells.reach_m
            evidence = memory.evidence(x, felt_m, felt_rad, sure_m)
            lost = self.familiarity(self.place.winner, felt_m, felt_rad, evidence, now.since_s)
            if not self.config.wall_memory.corrects:  # walls that do not correct do not contradict
                self.familiarity.reset_doubt()
                lost = self.familiarity.lost
            now.lost_s += now.since_s * int(lost.sum())
            now.since_s, now.someone_lost = 0.0, int(lost.any())
        return NavigationEstimate(
            oscillators.position_m,
            correction,
            place.winner,
            place.recruited,
            lost if self.batch is not None else lost[0],
        )

    def _compiles(self) -> bool:
        """Return whether the steps of this process and of these cells are compiled."""
        return self.batch is None and runs_compiled(self.walls.errors)

    def _step(
        self,
        speed_m_s: float,
        heading_rad: float,
        dt_s: float,
        wall_m: np.ndarray,
        wall_bearing_rad: np.ndarray,
        compass: bool,
        read: bool = False,
        sensed: bool = True,
    ) -> NavigationEstimate:
        """Do as :meth:`forward` for one animal by compiled steps."""
        boundary, memory, oscillators = self.boundary, self.walls, self.oscillators
        grid, place, familiarity = self.grid, self.place, self.familiarity
        nearest, bearing = boundary.respond_compiled(
            speed_m_s, heading_rad, wall_m, wall_bearing_rad, dt_s
        )
        now, corrects = self.now, self.config.wall_memory.corrects
        learns = not (now.someone_lost and familiarity.is_lost)
        dx, dy = memory.move_compiled(speed_m_s, heading_rad, dt_s)
        since_s = _since(now.since_s + dt_s, sensed)
        compares = sensed and since_s >= FAMILIARITY_PERIOD_S
        corrects_now = corrects and nearest < math.inf and memory.is_due
        if self._senses and not read and nearest < math.inf and (compares or corrects_now):
            wall_m, bearing = self._read_sheet(wall_m, bearing)
            corrects_now = corrects_now and len(wall_m) > 0
        correction = np.zeros(2)
        if corrects_now:
            x, y = oscillators.decode_compiled().tolist()
            start = np.array([x + dx, y + dy])
            end = start.copy()
            memory.update_compiled(end, wall_m, bearing, compass=compass, learns=learns)
            correction = end - start
            off_x, off_y = correction.tolist()
            dx, dy = dx + off_x, dy + off_y
        phases, position = oscillators.shift_compiled(dx, dy)
        rates = grid.rates_compiled(phases)
        winner, recruited = place.compete_compiled(
            rates, position, dt_s, learns if now.someone_lost else None
        )
        if compares:
            sure_m = SURE * self.config.boundary_cells.reach_m
            *evidence, error = memory.evidence_compiled(position, wall_m, bearing, sure_m)
            familiarity.compare_compiled(winner, wall_m, bearing, error, evidence, since_s)
            if not corrects:  # walls that do not correct do not contradict
                familiarity.reset_doubt()
            now.someone_lost = int(familiarity.is_lost)
            now.lost_s += since_s * now.someone_lost
            since_s = 0.0
        now.since_s = since_s
        said = np.array(winner), np.array(recruited), np.array(now.someone_lost > 0)
        return NavigationEstimate(*map(torch.from_numpy, (position.copy(), correction, *said)))

    def _read_sheet(self, wall_m: np.ndarray, bearing_rad: np.ndarray) -> list[np.ndarray]:
        sheet = cast(BoundarySheet, self.sheet)
        rates = sheet(torch.from_numpy(wall_m), torch.from_numpy(bearing_rad))
        return [part.numpy() for part in sheet.read(rates)[:2]]

    def _uses_walls(self, dt_s: float) -> bool:
        """Return whether walls are used in this step: to correct, or to compare."""
        corrects = self.walls.is_due and self.config.wall_memory.corrects
        return corrects or self.now.since_s + dt_s >= FAMILIARITY_PERIOD_S

    def observe(self, frame: Frame) -> np.ndarray | None:
        """Return the walls of a frame, ``(n, 2)``: as measured, or found in its ranges.

        Raises:
            BadFrame: If walls or ranges are invalid.
        """
        if frame.walls is not None:
            return checked_walls(frame.walls)
        if frame.ranges is not None:
            if self.sheet is not None:
                return self.sheet.walls_in_scan(frame.ranges)
            return walls_in_scan(frame.ranges, self.config.boundary_cells.reach_m)
        return None

    def step(self, now: StepInput, observation: np.ndarray | None) -> Correction:
        """Advance by a frame of the brain; return the walls' correction of position and heading."""
        before, motion, heading = self.heading_error_rad, now.motion, None
        if self.config.grid_cells.self_motion == "cells":
            heading = now.cells_heading_rad
            if now.cells_speed_m_s is not None:
                motion = motion._replace(v_m_s=now.cells_speed_m_s)
        self._estimate = self._advance(motion, now.compass_rad, observation, heading)
        dx, dy = self._estimate.correction_m.tolist()
        error = self.heading_error_rad
        turn = before - error
        if heading is not None:
            turn = self._hand_over(turn, now.compass_rad is not None)
        return Correction(dx, dy, turn, wrap_angle(self.now.heading_rad - error))

    def _hand_over(self, turn_rad: float, compass: bool) -> float:
        """Let head-direction cells take over a correction of their heading; return their turn.

        The error of a compass is learnt here: it would turn the cells back. Without a compass the
        heading is the cells' own, and they keep the correction, which is an error no longer.
        """
        if compass or not turn_rad:
            return 0.0
        self.walls.errors = self.walls.errors + self.walls.errors.new_tensor([0.0, turn_rad])
        self.now.heading_rad = wrap_angle(self.now.heading_rad + turn_rad)
        return turn_rad

    def advance(
        self, motion: Motion, compass_rad: float | None, walls: np.ndarray | None
    ) -> NavigationEstimate:
        """Advance one animal by a frame; see :meth:`forward`.

        Args:
            motion: Since the last frame.
            compass_rad: Measured heading; ``None``: it is integrated from the turns.
            walls: Distance (m) and bearing relative to the heading (rad) of each, ``(n, 2)``;
                ``None``: not looked for.

        Raises:
            BadFrame: If a number is invalid; nothing has changed then.
        """
        return self._advance(motion, compass_rad, None if walls is None else checked_walls(walls))

    def _advance(
        self,
        motion: Motion,
        compass_rad: float | None,
        walls: np.ndarray | None,
        cells_heading_rad: float | None = None,
    ) -> NavigationEstimate:
        """Do as :meth:`advance` by walls that were checked, and a heading of cells."""
        now, compass, sensed = self.now, compass_rad is not None, walls is not None
        if cells_heading_rad is not None:
            heading = wrap_angle(cells_heading_rad + now.turned_rad)
        elif compass_rad is not None:
            heading = wrap_angle(checked_number(compass_rad, "heading", "rad") + now.turned_rad)
        else:
            heading = wrap_angle(now.heading_rad + motion.w_rad_s * motion.dt_s)
        felt = np.empty((0, 2)) if walls is None else walls[walls[:, 0].argsort(kind="stable")]
        wall_m, bearing = felt.T.copy()
        if self._compiles():
            _check_duration(motion.dt_s)
            with torch.inference_mode():
                here = self._step(
                    motion.v_m_s, heading, motion.dt_s, wall_m, bearing, compass, sensed=sensed
                )
        else:
            columns = ([motion.v_m_s, heading], wall_m, bearing)
            device = self.walls.errors.device
            (speed, course), *felt_walls = (
                torch.as_tensor(column, dtype=torch.float64, device=device) for column in columns
            )
            here = self(speed, course, motion.dt_s, *felt_walls, compass=compass, sensed=sensed)
        now.heading_rad, now.compass = heading, int(compass)
        return here

    @property
    def heading_error_rad(self) -> float:
        """Learnt error of the measured heading of one animal, which is subtracted from it."""
        arrays = self.walls.arrays()  # of torch a number takes longer
        return float((self.walls.errors if arrays is None else arrays[4])[0, 1])

    @property
    def pose(self) -> Pose:
        """Position and heading of one animal, corrected by the learnt error of the heading."""
        x, y = self.oscillators.position_m.tolist()
        return Pose(x, y, wrap_angle(self.now.heading_rad - self.heading_error_rad))

    @property
    def estimate(self) -> PoseEstimate:
        """Position in metres, as ``frames.csv`` has it of a brain without pose cells."""
        x, y, _ = self.pose
        return PoseEstimate(x, y, 0.0)

    @property
    def lost(self) -> bool:
        """Whether the animal is lost, as of the last frame."""
        return self._estimate is not None and bool(self._estimate.lost)

    def vetoes(self, view: ViewMatch) -> bool:
        """Return whether a matched view was learnt implausibly far from the estimated position."""
        if view.is_new or view.template == NO_TEMPLATE or not self.seen["sure"][view.template]:
            return False
        x, y = self.seen["x_m"][view.template].item(), self.seen["y_m"][view.template].item()
        here = self.pose
        return math.hypot(x - here.x_m, y - here.y_m) > self._view_reach_m

    @property
    def _view_reach_m(self) -> float:
        return 3.0 * self.config.wall_memory.view_sigma_m

    def learn(self, now: StepInput, observation: Observation) -> None:
        """Store the position of a new view, or correct by a known one."""
        self.update_from_view(now.view)

    def follow(self, correction: Correction) -> None:
        """Correct by a landmark, or go to the pose at which a kidnapped robot was relocalised.

        Small corrections of the map do not move the cells: walls are more accurate.
        """
        here, position = self.pose, correction.position_m
        if correction.relocalises:
            if position is None:
                dx, dy = correction.displacement(here.theta_rad)
                position = (here.x_m + dx, here.y_m + dy)
            self.relocalise(Pose(*position, here.theta_rad), correction.sigma_m)
        elif position is not None:
            self.update_from_landmark(position, correction.sigma_m, correction.variance_m2)

    def belief(self, map_: LeadableMap) -> Belief:
        """Return pose and variance of the cells."""
        return Belief(self.pose, self.variance_m2)

    def decide(self, map_: LeadableMap, now: StepInput) -> Decision:
        """Go to the experience of the winning place cell; each place cell is an experience."""
        winner = NO_EXPERIENCE
        if self._estimate is not None and not self.lost:
            winner = int(self._estimate.place)
        return Decision(*map_.visit(winner, self.pose, now.motion.dt_s, now.frame))

    @without_gradients
    def update_from_view(self, view: ViewMatch) -> bool:
        """Store the position of a new view, or correct by that of a known one.

        A view learnt near the estimated position corrects it slightly. If several views in a row
        agree on another position, the animal was kidnapped or is lost: it relocalises there.

        Returns:
            Whether the animal relocalised.
        """
        now = self.now
        if view.template == NO_TEMPLATE:  # no image in this frame: the last view still counts
            return False
        here = self.pose
        if view.is_new:
            self.seen.append(
                x_m=here.x_m,
                y_m=here.y_m,
                heading_rad=here.theta_rad - view.relative_heading_rad,
                sure=float(not now.someone_lost),
            )
        known = view.template != now.last_view and not view.is_new
        now.last_view = view.template
        if not known or not self.seen["sure"][view.template]:
            return False
        x, y, heading = (self.seen[c][view.template].item() for c in ("x_m", "y_m", "heading_rad"))
        off_x, off_y, sigma = x - here.x_m, y - here.y_m, self.config.wall_memory.view_sigma_m
        if math.hypot(off_x, off_y) <= self._view_reach_m:
            now.views_agree = 0
            target = self.oscillators.position_m.new_tensor([x, y])
            step = self.walls.observe_position(self.oscillators.position_m, target, sigma)
            self.oscillators.shift(step)
            return False
        again = math.hypot(off_x - now.off_x_m, off_y - now.off_y_m) <= self._view_reach_m
        now.views_agree = now.views_agree + 1 if again else 1
        now.off_x_m, now.off_y_m = off_x, off_y
        needed = self.config.sessions.confirm
        if now.views_agree < (max(2, needed // 2) if now.someone_lost else needed):
            return False
        self.relocalise(Pose(x, y, heading + view.relative_heading_rad), sigma)
        return True

    def remembered(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centres of place cells ``(n, 2)``, links ``(m, 2)``, and walls ``(w, 2)``.

        A wall segment is given by the foot of the perpendicular from its anchor.
        """
        centres, links = (part.numpy(force=True) for part in self.place.graph())
        columns = self.walls.remembered()[0][:4]
        x, y, bearing, distance = (column.numpy(force=True) for column in columns)
        feet = np.column_stack([x + distance * np.cos(bearing), y + distance * np.sin(bearing)])
        return centres, links, feet

    @property
    def variance_m2(self) -> float:
        """Mean variance of x and y of the position of one animal."""
        return 0.5 * self.walls.expected_variance_m2[0].trace().item()

    @without_gradients
    def update_from_landmark(
        self, place_m: tuple[float, float], sigma_m: float, variance_m2: float
    ) -> bool:
        r"""Correct one animal by the position that a known landmark implies.

        A landmark cannot make the position surer than it was when the landmark was learnt: the
        variance :math:`R` of its measurement is such that :math:`P` becomes just that,

        .. math:: R = \frac{P (P_0 + \sigma^2)}{P - (P_0 + \sigma^2)}

        so that a landmark learnt a moment ago does not correct.

        Args:
            place_m: Position that the landmark implies.
            sigma_m: Standard deviation :math:`\sigma` of it.
            variance_m2: Variance :math:`P_0` of the position when the landmark was learnt.

        Returns:
            Whether the landmark passed the gate.
        """
        here, then = self.oscillators.position_m, variance_m2 + sigma_m**2
        variance = self.variance_m2
        if variance <= then:
            return True
        error = variance * then / (variance - then)
        off = math.hypot(place_m[0] - here[0].item(), place_m[1] - here[1].item())
        if off > self.config.wall_memory.gate * math.sqrt(2.0 * variance + sigma_m**2):
            return False
        target = here.new_tensor(place_m)
        self.oscillators.shift(self.walls.observe_position(here, target, math.sqrt(error)))
        return True

    @without_gradients
    def relocalise(self, pose: Pose, sigma_m: float) -> None:
        """Set pose and phases of one animal; its memory stays.

        Args:
            pose: Pose of the animal; a measured heading is kept.
            sigma_m: Standard deviation of the position.
        """
        now = self.now
        self.oscillators.place_at(self.oscillators.position_m.new_tensor([pose.x_m, pose.y_m]))
        now.heading_rad = wrap_angle(pose.theta_rad + self.heading_error_rad)
        self.walls.forget_position(sigma_m)
        self.place.forget_winner()
        self.familiarity.reset_doubt()
        now.someone_lost = now.views_agree = 0

    @property
    def rates(self) -> np.ndarray:
        """Rates of boundary cells, then of grid cells, of one animal."""
        parts = (self.boundary.rates, self.grid.rates)
        return np.concatenate([part.flatten().numpy(force=True) for part in parts])

    def recorded(self) -> dict[str, np.ndarray]:
        """Return the activity of the boundary, the grid and the place cells of one animal."""
        if self.batch is not None:
            return {}
        if self._compiles() and self.place._near is None:
            at, grid = self.oscillators.position_m.numpy(), self.grid.rates.numpy().reshape(-1)
            felt = self.boundary.rates.numpy().reshape(-1)
            place = self.place.responses_compiled(grid, at)
            return {"boundary": felt, "grid": grid, "place": place}
        rates = self.grid.rates.reshape(-1)
        parts = {
            "boundary": self.boundary.rates.reshape(-1),
            "grid": rates,
            "place": self.place.responses(rates, self.oscillators.position_m),
        }
        return {name: part.numpy(force=True) for name, part in parts.items()}

    def record_into(
        self, buffers: Mapping[str, np.ndarray], widths: dict[str, int], row: int
    ) -> bool:
        """Write the activity of all three kinds of cells by one compiled step."""
        place = self.place
        arrays = self.arrays() if place._near is None else None
        if arrays is None:
            return False
        try:
            rows = buffers["boundary"], buffers["grid"], buffers["place"]
        except KeyError:  # not all are recorded
            return False
        felt, grid, at = arrays
        n = place.record_compiled(row, felt, grid, at, *rows)
        if n >= 0:
            widths["place"] = n
        return n >= 0

    @without_gradients
    def rates_at(
        self, position_m: np.ndarray, heading_rad: np.ndarray, speed_m_s: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Compute boundary, grid and place cells at some positions of one animal.

        Boundary cells respond to the remembered walls, with an open gate; grid cells are at rest.
        """
        if self.batch is not None:
            return {}
        at = torch.as_tensor(position_m, dtype=torch.float64, device=self.walls.errors.device)
        walls, rows = self.walls.remembered()[0], []
        for some in at.split(_POSES):  # a table of all poses by all walls would be large
            felt = self.boundary.tuned_to(*walls_around(walls, some, self.config)).flatten(1)
            grid = self.grid.settled(self.oscillators.phases_at(some)).flatten(1)
            rows.append((felt, grid, self.place.responses_at(grid, some)))
        parts = map(torch.cat, zip(*rows, strict=True))
        named = zip(("boundary", "grid", "place"), parts, strict=True)
        return {name: part.numpy(force=True).astype(np.float32) for name, part in named}

    def arrays(self) -> Arrays | None:
        """Return rates of boundary and grid cells, and the position, as arrays of their memory.

        Returns:
            ``None`` where the steps are not compiled.
        """
        felt, grid = self.boundary._buffers["rates"], self.grid._buffers["rates"]
        at, kept = self.oscillators._buffers["position_m"], vars(self).get("_arrays")
        if kept is not None:
            tensors = kept[0]
            if tensors[0] is felt and tensors[1] is grid and tensors[2] is at:
                return kept[1]
        if not self._compiles():
            return None
        tensors = cast(tuple[Tensor, Tensor, Tensor], (felt, grid, at))
        arrays = tensors[0].numpy(), tensors[1].numpy(), tensors[2].numpy()
        vars(self)["_arrays"] = tensors, arrays
        return arrays

    def cell_properties(self) -> dict[str, dict[str, np.ndarray]]:
        """Return bearing and distance of boundary cells, the spacings of grid cells, and centres.

        The centres are those of place cells, in the frame of the cells.
        """
        angle, away = (
            part.numpy(force=True).astype(np.float64)
            for part in (self.boundary.preferred_rad, self.boundary.preferred_m)
        )
        spacing = np.asarray(self.config.grid_cells.spacings_m)
        cells = self.grid.rates.numel() // len(spacing)
        centres = self.place.graph()[0].numpy(force=True)
        return {
            "boundary": {
                "bearing_rad": np.repeat(angle, len(away)),
                "distance_m": np.tile(away, len(angle)),
            },
            "grid": {"spacing_m": np.repeat(spacing, cells)},
            "place": {"centre_x_m": centres[:, 0], "centre_y_m": centres[:, 1]},
        }

    def counts(self) -> dict[str, float]:
        """Return how much one animal has learnt, and for how long it was lost."""
        return {
            "place_cells": int(self.place.n_cells),
            "walls": int(self.walls.n_walls),
            "activated_boundary_cells": int(self.familiarity.n_activated()),
            "lost_s": round(self.now.lost_s, 3),
        }

    def scalars(self) -> dict[str, float]:
        """Return the TensorBoard curves of one animal."""
        return {
            "cells/place_cells": float(self.place.n_cells),
            "cells/walls": float(self.walls.n_walls),
            "cells/activated_boundary_cells": float(self.familiarity.n_activated()),
            "cells/boundary_activity": float(self.boundary.activity),
            "cells/doubt_s": float(self.familiarity.doubt_s),
        }

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield references to place cells, links or walls that do not exist."""
        yield from navigation_faults(state, n_experiences if leading_class(config) is cls else None)

    def renumber(self, change: Renumbering) -> None:
        """Drop the positions of views that are not kept."""
        if self.seen.n:
            self.seen.replace(
                **{name: change.rows_of_views(self.seen[name]) for name in self.seen.columns}
            )
        self.now.last_view = change.view(self.now.last_view)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Merge place cells, walls and views of two sessions in the frame of the loaded one."""
        return join_navigation(loaded, partial, join)

    def frames(self, loaded: State, partial: State, join: Join) -> tuple[Pose, Pose] | None:
        """Align the frames of two sessions by the views that both know."""
        return view_frames(loaded, partial, join)

    def match(
        self, loaded: "Population", maps: tuple[np.ndarray, np.ndarray], config: BrainConfig
    ) -> tuple[Match | None, str]:
        """Find the alignment of two maps by the walls of both sessions."""
        if not isinstance(loaded, NavigationCells):
            raise TypeError(
                f"NavigationCells: cannot be matched with {type(loaded).__name__}; "
                "expected NavigationCells"
            )
        both = loaded, self
        compass = all(cells.now.compass for cells in both)
        one, other = (outline_of(*cells.walls.remembered()[0][:4]) for cells in both)
        return match_walls((one, other), maps, config, compass=compass)


def _check_duration(dt_s: float) -> None:
    if not 0.0 <= dt_s < math.inf:  # NaN too
        raise BadFrame(f"time since the last step is {dt_s} s; expected 0 or more")


def _since(since_s: float, sensed: bool) -> float:
    """Return the time since the last comparison; without sensing it counts as one period at most.

    Example:
        >>> _since(0.55, True), _since(60.0, False)
        (0.55, 0.5)
    """
    return since_s if sensed else min(since_s, FAMILIARITY_PERIOD_S)
