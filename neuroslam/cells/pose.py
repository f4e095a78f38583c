"""Pose cells: an attractor over x, y and heading, moved by odometry and corrected by views."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.attractor import (
    path_integrate,
)
from neuroslam.cells.convolve import Packet
from neuroslam.cells.pose_joining import move_session
from neuroslam.cells.side_by_side import move_all
from neuroslam.cells.torus import Torus
from neuroslam.config import BrainConfig, PoseCellConfig
from neuroslam.errors import MapError, listed
from neuroslam.geometry import TWO_PI
from neuroslam.state.join import Join, MovedCells
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State, renamed
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
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, Motion, PoseEstimate, ViewMatch

SATURATED_DECAY = math.log(30.0) / 1.2
"""Fatigue from which on a view does not inject."""

_SUM_TOLERANCE = {"float32": 1e-4, "float64": 1e-9}


def _no_slip(like: Tensor) -> list[float] | Tensor:
    return [0.0, 0.0, 0.0] if like.dim() == 1 else torch.zeros_like(like)


@dataclass
class _Now:
    slip: list[float] | Tensor  # lag of the estimate behind odometry in cells: x, y, theta
    injected: bool = False  # since the last step


@register("pose")
class PoseCellNetwork(Torus, Population):
    """Continuous attractor on the torus ``(n_theta, n_xy, n_xy)``; a packet encodes the pose.

    :func:`~neuroslam.cells.attractor.settle` and
    :func:`~neuroslam.cells.attractor.path_integrate` have the mathematics. The state is the
    window of active cells (buffers ``window`` and ``origin``) and the binding of every view to
    the pose at which it was learnt (``bindings``).

    Args:
        config: Size and dynamics.
        batch: Number of brains side by side; ``None`` for one. A batch integrates motion and
            binds no views; correct it by setting ``activity``.

    Example:
        >>> cells = PoseCellNetwork(PoseCellConfig(cell_size_m=0.5))
        >>> start = cells.estimate
        >>> after = cells.integrate(Motion(v_m_s=1.0, w_rad_s=0.0, dt_s=0.5))
        >>> round(start.x - after.x, 2), round(start.y - after.y, 2)  # it starts heading along -x
        (0.99, 0.0)
    """

    name = "pose_cells"
    merge_sections = ("pose_cells",)
    rank = 3
    relaxes_map = True
    needs_views = True

    slip: Tensor

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the pose cells of a brain."""
        return cls(config.pose_cells)

    def __init__(self, config: PoseCellConfig, batch: int | None = None) -> None:
        super().__init__()
        c = config
        factors = (
            [(c.excite_size, c.excite_std_theta), *2 * [(c.excite_size, c.excite_std_xy)]],
            [(c.inhibit_size, c.inhibit_std_theta), *2 * [(c.inhibit_size, c.inhibit_std_xy)]],
        )
        self._set_up(config, batch, (c.n_theta, c.n_xy, c.n_xy), factors)
        dtype = getattr(torch, config.precision)
        self.bindings = GrowingTable(
            {name: ((), torch.float64) for name in ("x", "y", "theta")} | {"decay": ((), dtype)}
        )
        self.last = Scalars(view=NO_TEMPLATE)
        brains = () if batch is None else (batch,)
        slip = torch.zeros(*brains, 3, dtype=torch.float64)
        self.register_buffer("slip", slip)
        self._now = _Now(slip)
        self.reset()

    def _set_activity(self, activity: Tensor) -> None:
        super()._set_activity(activity)
        self._now.slip = _no_slip(self.slip)

    @property
    def estimate(self) -> PoseEstimate | Tensor:
        """Centre of the dominant packet in cells; in a batch x, y, theta, shape ``(batch, 3)``."""
        return self.centre

    def integrate(self, motion: Motion) -> PoseEstimate | Tensor:
        """Settle the attractor, move its activity by ``motion`` and return the estimate.

        Args:
            motion: m/s, rad/s, s; in a batch the first two are tensors of shape ``(batch,)``.

        Raises:
            MapError: If inhibition silenced every cell.
        """
        c, now = self.config, self._now
        distance = motion.v_m_s * motion.dt_s / c.cell_size_m
        turn = motion.w_rad_s * motion.dt_s * c.n_theta / TWO_PI
        follows = c.exact_gain and not now.injected
        if not follows:
            now.slip = [0.0, 0.0, 0.0] if self.batch is None else _no_slip(self.slip)
            now.injected = False
        before = self.estimate if follows else None
        if self.batch is None:
            x, y, theta = cast(list[float], now.slip)
            self._move(distance, turn + theta, (x, y))
            if follows:
                self._measure_slip(cast(PoseEstimate, before), distance, turn)
        else:
            slip = cast(Tensor, now.slip)
            self._move_all(distance, turn + slip[:, 2], slip[:, :2])
            if follows:
                self._measure_slips(cast(Tensor, before), distance, turn)
        return self.estimate

    def nudge(self, dx_cells: float, dy_cells: float, turn_cells: float) -> None:
        """Move and rotate the activity by a correction of the pose."""
        if self.batch is None:
            self.packet = path_integrate(self.packet, 0.0, turn_cells, (dx_cells, dy_cells))
        else:
            aside = torch.tensor([dx_cells, dy_cells]).expand(self.batch, 2)
            self.packet = move_all(self.packet, 0.0, turn_cells, aside)

    def _measure_slip(self, before: PoseEstimate, distance: float, turn: float) -> None:
        r"""Measure the lag of the estimate behind odometry, for which the next step compensates.

        Clipping at zero holds a moving packet back, by a tenth at 0.1 cells a step. Only views may
        correct the estimate, not the attractor itself, so the slip
        :math:`s \leftarrow s + \Delta_\text{odometry} - \Delta_\text{estimate}` is fed back,
        and reset where the estimate jumped (another packet won) or a view has just injected.
        """
        after, slip = cast(PoseEstimate, self.estimate), cast(list[float], self._now.slip)
        sizes = (self.shape[2], self.shape[1], self.shape[0])
        heading = TWO_PI * before.theta / self.shape[0]
        asked = (distance * math.cos(heading), distance * math.sin(heading), turn)
        errors = [
            (was + step - is_ + n / 2) % n - n / 2
            for was, step, is_, n in zip(before, asked, after, sizes, strict=True)
        ]
        jumped = max(map(abs, errors)) > 1.0
        self._now.slip = (
            [0.0, 0.0, 0.0] if jumped else [s + e for s, e in zip(slip, errors, strict=True)]
        )

    def _measure_slips(
        self, before: Tensor, distance: float | Tensor, turn: float | Tensor
    ) -> None:
        """Do the same for each brain of a batch."""
        after, slip = cast(Tensor, self.estimate), cast(Tensor, self._now.slip)
        sizes = (self.shape[2], self.shape[1], self.shape[0])
        heading = TWO_PI * before[:, 2] / self.shape[0]
        asked = torch.stack(
            torch.broadcast_tensors(distance * heading.cos(), distance * heading.sin(), turn),
            dim=1,
        )
        n = torch.tensor(sizes, dtype=before.dtype, device=before.device)
        errors = (before + asked - after + n / 2) % n - n / 2
        kept = (errors.abs() <= 1.0).all(1, keepdim=True)
        self._now.slip = (slip + errors.to(slip)).where(kept, 0.0)

    def update_from_view(self, view: ViewMatch) -> None:
        r"""Bind a new view to the present estimate; inject activity where a known one was bound.

        .. math:: \delta = \text{energy} \cdot \tfrac{1}{30} \left(30 - e^{1.2\,\text{decay}}\right)

        while positive. ``decay`` grows each time the same view matches in a row, and every view
        recovers by ``restore`` each frame, so that a robot at a standstill is not displaced.

        Raises:
            MapError: If ``view`` is a template that was never bound.
        """
        c = self.config
        decay = self.bindings["decay"]
        if view.is_new:
            if view.template != self.bindings.n:
                raise MapError(
                    f"PoseCellNetwork: new view {view.template}, expected {self.bindings.n}; "
                    "views and bindings must come from the same session"
                )
            at = cast(PoseEstimate, self.estimate)
            self.bindings.append(x=at.x, y=at.y, theta=at.theta, decay=c.active_decay)
            decay = self.bindings["decay"]
        elif view.template != NO_TEMPLATE:
            if not 0 <= view.template < self.bindings.n:
                raise MapError(
                    f"PoseCellNetwork: view {view.template} is not bound, there are {len(decay)}"
                )
            self._inject_known(view)
        decay.sub_(c.restore).clamp_min_(c.active_decay)
        self.last.view = view.template

    def _inject_known(self, view: ViewMatch) -> None:
        c, b = self.config, self.bindings
        few = b.n < c.inject_after
        if not (view.template < b.n - c.inject_after or (few and c.inject_while_few)):
            return
        if view.template == self.last.view:
            b["decay"][view.template] += c.active_decay
        decay = b["decay"][view.template].item()
        if decay >= SATURATED_DECAY:
            return
        energy = c.inject_energy / 30.0 * (30.0 - math.exp(1.2 * decay))
        turned = view.relative_heading_rad * c.n_theta / TWO_PI
        at = PoseEstimate(
            b["x"][view.template].item(),
            b["y"][view.template].item(),
            (b["theta"][view.template].item() + turned) % c.n_theta,
        )
        if c.inject_at_cell:
            at = PoseEstimate(*(math.floor(value) for value in at))
        self._inject(at, energy)
        self._now.injected = True

    def relocalise(self, view: ViewMatch) -> None:
        """Move the activity to where a known view is bound: a sequence of views leaves no doubt."""
        if not 0 <= view.template < self.bindings.n:
            return
        n_theta, n_y, n_x = self.shape
        turned = view.relative_heading_rad * n_theta / TWO_PI
        bound = [self.bindings[name][view.template].item() for name in ("x", "y", "theta")]
        here = cast(PoseEstimate, self.estimate)
        moved = [
            (to + by - at + n / 2) % n - n / 2
            for to, by, at, n in zip(
                bound, (0.0, 0.0, turned), here, (n_x, n_y, n_theta), strict=True
            )
        ]
        self.nudge(*moved)
        self._now.injected = True  # the next step measures no slip across the jump

    def forward(self, motion: Motion, view: ViewMatch) -> PoseEstimate:
        """Advance one frame: inject by the view, settle the attractor, move it by odometry."""
        self.update_from_view(view)
        return cast(PoseEstimate, self.integrate(motion))

    def step(self, now: StepInput, observation: Observation) -> None:
        """Advance by a frame of the brain; see :meth:`forward`."""
        self(now.motion, now.view)

    @property
    def heading_rad(self) -> float:
        """Heading of the estimate in the frame of the cells."""
        return TWO_PI * cast(PoseEstimate, self.estimate).theta / self.config.n_theta

    def follow(self, correction: Correction) -> None:
        """Move and rotate the activity by the correction of another population."""
        if not correction.moves:
            return
        c = self.config
        dx, dy = correction.displacement(self.heading_rad)
        self.nudge(dx / c.cell_size_m, dy / c.cell_size_m, correction.turn_rad * c.n_theta / TWO_PI)

    def belief(self, map_: LeadableMap) -> Belief:
        """Return the pose on the map; that of the cells repeats on the torus."""
        return Belief(map_.pose, 0.0, map_.current, map_.pose_table)

    def decide(self, map_: LeadableMap, now: StepInput) -> Decision:
        """Create, link or set an experience by the view and the pose-cell estimate."""
        tracking = now.tracking
        if tracking is not None and tracking.kind in ("link", "set"):
            self.relocalise(now.view)
        cells = cast(PoseEstimate, self.estimate)
        return Decision(
            *map_(
                now.motion, now.view, cells, now.frame,
                kidnapped=now.vetoed, tracking=tracking,
            )
        )  # fmt: skip

    @property
    def rates(self) -> np.ndarray:
        """Activity of all cells, ``(n_theta * n_xy * n_xy,)``."""
        return self.activity.flatten().numpy(force=True)

    def scalars(self) -> dict[str, float]:
        """Return the activity of the most active cell."""
        return {"cells/peak": self.peak}

    def images(self) -> dict[str, tuple[np.ndarray, ...]]:
        """Return the activity summed over heading, and over y: x-y, and x-heading."""
        activity = self.activity.numpy(force=True)
        return {"cells/activity": (activity.sum(axis=0), activity.sum(axis=1))}

    def renumber(self, change: Renumbering) -> None:
        """Drop the bindings of templates that are not kept."""
        self.bindings.replace(
            **{name: change.rows_of_views(self.bindings[name]) for name in self.bindings.columns}
        )
        self.last.view = change.view(self.last.view)

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Move bindings and activity of the partial session on the torus, and merge the bindings.

        The activity moves too, so that it stays at the robot's pose (multisession RatSLAM,
        Algorithm 1, line 4). The fatigue of the views is kept. :func:`moved_cells` has the
        equation.
        """
        kept = torch.from_numpy(join.kept_views)
        moved = torch.from_numpy(join.view_cells).unbind(1)
        columns: dict[str, Tensor] = dict(zip(("x", "y", "theta"), moved, strict=True))
        columns["decay"] = partial["bindings.decay"]
        merged = {
            f"bindings.{name}": torch.cat([loaded[f"bindings.{name}"], column[kept]])
            for name, column in columns.items()
        }
        n_x, n_y, n_theta = join.torus
        origin = tuple(partial["origin"].tolist())
        x, y, theta = join.cell_shift
        packet = Packet(partial["window"], origin, (n_theta, n_y, n_x))
        packet = path_integrate(packet, 0.0, theta, (x, y))
        return merged | {
            "window": packet.values,
            "origin": torch.tensor(packet.origin),
            "slip": partial["slip"],
            "last.view": renamed(partial["last.view"], join.views),
        }

    def moved_cells(
        self, loaded: State, partial: State, match: Match, config: BrainConfig
    ) -> MovedCells:
        """Move the partial session on the torus, so that the matched experiences coincide."""
        return move_session(loaded, partial, match, config)

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield activity and bindings that are invalid."""
        window, origin, bound = state["window"], state["origin"].tolist(), len(state["bindings.x"])
        if bound != n_views:
            yield f"{n_views} views, {bound} of them bound to pose cells"
        c = config.pose_cells
        torus = (c.n_theta, c.n_xy, c.n_xy)
        if not -1 <= state["last.view"] < n_views:
            yield f"{cls.name}.last.view: is {state['last.view']}, expected -1 to {n_views - 1}"
        if not all(0 < size <= limit for size, limit in zip(window.shape, torus, strict=True)):
            yield f"{cls.name}.window: {window.shape} cells do not fit the torus of {torus}"
        if not all(0 <= at < limit for at, limit in zip(origin, torus, strict=True)):
            yield f"{cls.name}.origin: {tuple(origin)} is not on the torus of {torus}"
        if (window < 0).any():
            cell = tuple(np.argwhere(window < 0)[0].tolist())
            n = int((window < 0).sum())
            yield f"{cls.name}.window: {n} cells are negative, the first {cell}"
        total = window.sum(dtype=np.float64).item()
        if abs(total - 1.0) > _SUM_TOLERANCE[window.dtype.name]:
            yield f"{cls.name}.window: adds up to {total:.6g}, expected 1"
        for axis, limit in zip(("x", "y", "theta"), torus[::-1], strict=True):
            at = state[f"bindings.{axis}"]
            rows = np.flatnonzero((at < 0) | (at > limit))
            if len(rows):
                name = f"{cls.name}.bindings.{axis}"
                yield f"{name}: rows {listed(rows)} are not on the torus of {torus}"

    def _write_buffers(self) -> None:
        super()._write_buffers()
        self.slip = torch.as_tensor(self._now.slip, dtype=torch.float64)

    def _read_buffers(self) -> None:
        super()._read_buffers()
        self._now = _Now(self.slip.tolist() if self.batch is None else self.slip)
