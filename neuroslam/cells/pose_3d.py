r"""Pose cells of four degrees of freedom: x, y, z and heading, and the heights of a map.

Two attractors represent the pose, as in NeuroSLAM (F. Yu, J. Shang, Y. Hu, M. Milford, "NeuroSLAM:
a brain-inspired SLAM system for 3D environments", Biological Cybernetics 113, 2019): 3-D grid cells
on a torus of x, y and z (:mod:`~neuroslam.cells.grid_3d`) and conjunctive cells of height and
heading (:mod:`~neuroslam.cells.yaw_height`). The heading of the second directs the movement of the
first, and a view is bound to a position in both:

.. math:: (\Delta x, \Delta y, \Delta z, \Delta\theta) =
          (v\,dt \cos\theta,\; v\,dt \sin\theta,\; v_z\,dt,\; \omega\,dt)

The map of the brain keeps x, y and heading of its experiences; this population adds their heights,
measured by the rises between them (:mod:`~neuroslam.mapping.heights`). Storeys look alike, so
views match only experiences whose height is within ``gate_m`` of the robot's.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neuroslam.cells.grid_3d import GridCells3D
from neuroslam.cells.pose import SATURATED_DECAY
from neuroslam.cells.pose_3d_states import differing_heights, merge_pose_3d, state_faults
from neuroslam.cells.pose_joining import move_session
from neuroslam.cells.yaw_height import YawHeightCells
from neuroslam.config import BrainConfig, MapConfig, PoseCellConfig, Section
from neuroslam.config.bounds import MOST_CELLS
from neuroslam.errors import ConfigError, MapError
from neuroslam.geometry import TWO_PI, wrap_angle
from neuroslam.mapping.heights import Rises, contract_rises, relax_heights
from neuroslam.state.join import Join, MovedCells
from neuroslam.state.match import Match, Pairs
from neuroslam.state.mergeable import State
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
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import (
    NO_EXPERIENCE,
    NO_TEMPLATE,
    Motion,
    PoseEstimate,
    Revoked,
    Tracking,
    ViewMatch,
)

_SETTLING = 0.05
"""Share of its distance in height by which a tracked robot settles at each experience it passes."""


_TURNED_AWAY = 0.6
"""Heading, rad, from which a tracked robot is not at an experience."""


class Pose3DConfig(Section):
    """Pose cells of four degrees of freedom; x, y, heading and kernels are of ``[pose_cells]``."""

    n_z: int = Field(
        default=21,
        ge=7,
        le=MOST_CELLS,
        description="cells along height; larger: activity repeats at larger distances, each step "
        "takes longer. The torus wraps around, so heights are not bounded",
    )
    cell_height_m: float = Field(
        default=0.5, gt=0, description="height of a cell; larger: coarser height"
    )
    gate_m: float = Field(
        default=1.2,
        gt=0,
        description="largest difference of height at which a view can match that of an experience; "
        "below half a storey, above the drift of height between two visits",
    )


class PoseEstimate3D(NamedTuple):
    """Centre of the dominant packets in cells; each coordinate in [0, size of its axis)."""

    x: float
    y: float
    z: float
    theta: float


class _Now(Scalars):
    """Last view, rise since the current experience, and whether relaxation has converged."""

    view: int
    rise_m: float
    at: int
    at_rest: int
    injected: int


def _settled(
    map_: LeadableMap, motion: Motion, view: ViewMatch, tracking: Tracking
) -> tuple[Tracking, ViewMatch]:
    """Return how a tracked robot arrives at an experience: it settles at its heading by and by.

    Where it has turned away from the heading there, as at the foot of a ramp, it stays at the last
    experience, so that odometry goes on from there when the known places have been left.
    """
    there = map_.pose_table[tracking.experience, 2]
    heading = map_.pose.theta_rad + motion.w_rad_s * motion.dt_s
    apart = wrap_angle(heading - there - view.relative_heading_rad)
    if abs(apart) > _TURNED_AWAY:
        return tracking._replace(experience=map_.current), view
    turned = view.relative_heading_rad + (1.0 - _SETTLING) * apart
    return tracking, view._replace(relative_heading_rad=turned)


@register("pose_3d")
class PoseCells3D(Population):
    """Pose cells in x, y, z and heading, with the heights of the map; see the module's text.

    State: activity of ``grid`` and ``sheet``, lag of both behind odometry (``slip``), the binding
    of every view (``bindings``), the height of every experience (``levels``) and ``rises``.

    Args:
        config: Sizes along x, y and heading, kernels and injection.
        section: Height.
        map_config: Correction and loops of the relaxation.
        batch: Number of robots side by side; ``None`` for one. A batch integrates motion and binds
            no views.

    Example:
        >>> cells = PoseCells3D(PoseCellConfig(cell_size_m=0.5))
        >>> start = cells.estimate_3d
        >>> after = cells.integrate(Motion(v_m_s=1.0, w_rad_s=0.0, dt_s=0.5), v_z_m_s=0.5)
        >>> round(start.x - after.x, 2), round(after.z - start.z, 2)  # it starts heading along -x
        (1.0, 0.5)
    """

    name = "pose_3d"
    config_section = Pose3DConfig
    merge_sections = ("pose_cells",)
    rank = 4
    relaxes_map = True
    needs_views = True

    slip: Tensor

    @classmethod
    def build(cls, config: BrainConfig, leader: type[Population]) -> Self:
        """Make the pose cells of a brain."""
        section = cast(Pose3DConfig, config.section(cls.kind))
        return cls(config.pose_cells, section, config.map)

    def __init__(
        self,
        config: PoseCellConfig,
        section: Pose3DConfig | None = None,
        map_config: MapConfig | None = None,
        batch: int | None = None,
    ) -> None:
        super().__init__()
        self.config, self.settings = config, section or Pose3DConfig()
        self.map_config, self.batch = map_config or MapConfig(), batch
        n_z = self.settings.n_z
        if max(config.excite_size, config.inhibit_size) > n_z:
            raise ConfigError(
                f"pose_3d.n_z is {n_z}, but kernels of pose_cells are "
                f"{max(config.excite_size, config.inhibit_size)} cells wide; expected n_z of at "
                "least that"
            )
        self.grid = GridCells3D(config, n_z, batch)
        self.sheet = YawHeightCells(config, n_z, batch)
        dtype = getattr(torch, config.precision)
        self.bindings = GrowingTable(
            {name: ((), torch.float64) for name in ("x", "y", "z", "theta")}
            | {"decay": ((), dtype)}
        )
        self.levels = GrowingTable({name: ((), torch.float64) for name in ("z_m", "cell_z")})
        self.rises = GrowingTable(
            {name: ((), torch.int64) for name in ("source", "target")}
            | {"rise_m": ((), torch.float64)}
        )
        self.now = _Now(view=NO_TEMPLATE, rise_m=0.0, at=NO_EXPERIENCE, at_rest=1, injected=0)
        brains = () if batch is None else (batch,)
        # Lag of the estimates behind odometry: x, y, z of the grid, then height and heading.
        self.register_buffer("slip", torch.zeros(*brains, 5, dtype=torch.float64))
        self._slip: list[float] | Tensor = self.slip  # the one in use; the buffer is for states
        self._sizes = (config.n_xy, config.n_xy, n_z, n_z, config.n_theta)
        self.register_state_dict_pre_hook(Calls("_write_slip"))
        self.register_load_state_dict_post_hook(Calls("_read_slip"))

    # ----------------------------------------------------------------------------- activity

    @property
    def estimate_3d(self) -> PoseEstimate3D:
        """Pose of the dominant packets, in cells."""
        x, y, z = cast(tuple[float, float, float], self.grid.estimate)
        return PoseEstimate3D(x, y, z, self.sheet.heading_cells)

    @property
    def estimate(self) -> PoseEstimate:
        """The same without height."""
        x, y, _, theta = self.estimate_3d
        return PoseEstimate(x, y, theta)

    def integrate(self, motion: Motion, v_z_m_s: float | Tensor = 0.0) -> PoseEstimate3D | Tensor:
        """Settle both attractors, move their activity by ``motion``, and return the estimate.

        The lag of the estimates behind odometry is measured and compensated for, as in
        :meth:`~neuroslam.cells.pose.PoseCellNetwork.integrate`; it is reset where one of them
        jumped, or a view has just injected.

        Args:
            motion: m/s, rad/s, s; in a batch the first two are tensors of shape ``(batch,)``.
            v_z_m_s: Speed upwards; in a batch likewise.

        Returns:
            x, y, z and heading in cells; in a batch ``(batch, 4)``.

        Raises:
            MapError: If inhibition silenced every cell.
        """
        c = self.config
        ahead = motion.v_m_s * motion.dt_s / c.cell_size_m
        up = v_z_m_s * motion.dt_s / self.settings.cell_height_m
        turn = motion.w_rad_s * motion.dt_s * c.n_theta / TWO_PI
        follows = c.exact_gain and not self.now.injected
        if not follows:
            self._slip, self.now.injected = torch.zeros_like(self.slip), 0
        if self.batch is not None:
            along, rise, around = (
                torch.as_tensor(by, dtype=torch.float64, device=self.slip.device)
                for by in (ahead, up, turn)
            )
            return self._integrate_all(along, rise, around, follows)
        return self._integrate_one(float(ahead), float(up), float(turn), follows)

    def _integrate_one(self, ahead: float, up: float, turn: float, follows: bool) -> PoseEstimate3D:
        grid, sheet = self.grid, self.sheet
        before = (*grid.estimate, *sheet.estimate)
        heading = TWO_PI * before[4] / self.config.n_theta
        asked = (ahead * math.cos(heading), ahead * math.sin(heading), up, up, turn)
        if isinstance(self._slip, Tensor):
            self._slip = self._slip.tolist()
        dx, dy, dz, rise, around = (a + s for a, s in zip(asked, self._slip, strict=True))
        after = (*grid(dx, dy, dz), *sheet(rise, around))
        if follows:
            errors = [
                (was + by - now + n / 2) % n - n / 2
                for was, by, now, n in zip(before, asked, after, self._sizes, strict=True)
            ]
            jumped = max(map(abs, errors)) > 1.0
            self._slip = [0.0 if jumped else s + e for s, e in zip(self._slip, errors, strict=True)]
        return PoseEstimate3D(after[0], after[1], after[2], after[4])

    def _integrate_all(self, ahead: Tensor, up: Tensor, turn: Tensor, follows: bool) -> Tensor:
        before = self._estimates()
        heading = before[:, 4] * (TWO_PI / self.config.n_theta)
        rows = (ahead * heading.cos(), ahead * heading.sin(), up, up, turn)
        asked = torch.stack([row.to(before).expand(len(before)) for row in rows], dim=1)
        slip = cast(Tensor, self._slip)
        dx, dy, dz, rise, around = (asked + slip.to(asked)).unbind(1)
        self.grid(dx, dy, dz)
        self.sheet(rise, around)
        after = self._estimates()
        if follows:
            n = torch.tensor(self._sizes).to(before)
            errors = (before + asked - after + n / 2) % n - n / 2
            kept = (errors.abs() <= 1.0).all(1, keepdim=True)
            self._slip = (slip + errors.to(slip)).where(kept, 0.0)
        return after[:, [0, 1, 2, 4]]

    def _estimates(self) -> Tensor:
        """Return x, y, z of the grids, height and heading of the sheets, ``(batch, 5)``."""
        return torch.cat([cast(Tensor, one.estimate) for one in (self.grid, self.sheet)], dim=1)

    def _write_slip(self) -> None:
        self.slip = torch.as_tensor(self._slip, dtype=torch.float64, device=self.slip.device)

    def _read_slip(self) -> None:
        self._slip = self.slip

    def _apply(self, fn: object, recurse: bool = True) -> "PoseCells3D":
        self._write_slip()
        super()._apply(cast(Callable[..., Any], fn), recurse)
        self._read_slip()
        return self

    def update_from_view(self, view: ViewMatch) -> None:
        """Bind a new view to the present estimate; inject activity where a known one was bound.

        :meth:`~neuroslam.cells.pose.PoseCellNetwork.update_from_view` has the rule; activity is
        injected into both attractors.

        Raises:
            MapError: If ``view`` is a template that was never bound.
        """
        c, b = self.config, self.bindings
        if view.is_new:
            if view.template != b.n:
                raise MapError(
                    f"PoseCells3D: new view {view.template}, expected {b.n}; views and bindings "
                    "must come from the same session"
                )
            b.append(**self.estimate_3d._asdict(), decay=c.active_decay)
        elif view.template != NO_TEMPLATE:
            if not 0 <= view.template < b.n:
                raise MapError(f"PoseCells3D: view {view.template} is not bound, there are {b.n}")
            self._inject_known(view)
        b["decay"].sub_(c.restore).clamp_min_(c.active_decay)
        self.now.view = view.template

    def relocalise(self, view: ViewMatch) -> None:
        """Move the activity to where a known view is bound: a sequence of views leaves no doubt."""
        if not 0 <= view.template < self.bindings.n:
            return
        n_theta = self.config.n_theta
        turned = view.relative_heading_rad * n_theta / TWO_PI
        bound = (self.bindings[name][view.template].item() for name in ("x", "y", "z", "theta"))
        sizes = (self._sizes[0], self._sizes[1], self._sizes[2], n_theta)
        dx, dy, dz, turn = (
            (to + by - at + n / 2) % n - n / 2
            for to, by, at, n in zip(
                bound, (0.0, 0.0, 0.0, turned), self.estimate_3d, sizes, strict=True
            )
        )
        self.grid.shift(dx, dy, dz)
        self.sheet.shift(dz, turn)
        self.now.injected = 1  # the next step measures no slip across the jump

    def _inject_known(self, view: ViewMatch) -> None:
        c, b = self.config, self.bindings
        few = b.n < c.inject_after
        if not (view.template < b.n - c.inject_after or (few and c.inject_while_few)):
            return
        if view.template == self.now.view:
            b["decay"][view.template] += c.active_decay
        decay = b["decay"][view.template].item()
        if decay >= SATURATED_DECAY:
            return
        energy = c.inject_energy / 30.0 * (30.0 - math.exp(1.2 * decay))
        x, y, z, theta = (b[name][view.template].item() for name in ("x", "y", "z", "theta"))
        turned = view.relative_heading_rad * c.n_theta / TWO_PI
        self.grid.inject(x, y, z, energy)
        self.sheet.inject(z, (theta + turned) % c.n_theta, energy)
        self.now.injected = 1

    # ------------------------------------------------------------------------------- heights

    @property
    def z_m(self) -> float:
        """Height of the robot on the map, above where the map began."""
        at = self.now.at
        return self.now.rise_m + (0.0 if at < 0 else float(self.levels.array("z_m")[at]))

    @property
    def experience_heights_m(self) -> np.ndarray:
        """Height of every experience, ``(n,)``; a copy."""
        return self.levels.array("z_m").copy()

    @property
    def measured_rises(self) -> Rises:
        """All rises, as arrays; a copy."""
        return Rises(*(self.rises.array(name).copy() for name in Rises._fields))

    def _follow_map(self, before: int, decision: Decision, tracked: bool) -> None:
        """Note the height of a new experience, and the rise to the one that the robot went to.

        A robot that is tracked along known links settles at their height by and by, so that it
        leaves them where it climbs and they do not.
        """
        n, there = self.now, decision.experience
        if decision.action == "create":
            self.levels.append(z_m=self.z_m, cell_z=self.estimate_3d.z)
        if decision.action in ("create", "link") and before not in (NO_EXPERIENCE, there):
            source, target = self.rises.array("source"), self.rises.array("target")
            known = ((source == before) & (target == there)) | (
                (source == there) & (target == before)
            )
            if not known.any():
                self.rises.append(source=before, target=there, rise_m=n.rise_m)
                n.at_rest = int(n.at_rest and decision.action == "create")
        if tracked and decision.action == "link":
            n.rise_m = (1.0 - _SETTLING) * (self.z_m - float(self.levels.array("z_m")[there]))
        elif decision.action != "none":
            n.rise_m = 0.0
        elif there != n.at != NO_EXPERIENCE:  # it left known places near another experience
            n.rise_m += float(self.levels.array("z_m")[n.at] - self.levels.array("z_m")[there])
        n.at = there

    def _undo(self, revoked: Revoked) -> None:
        """Drop the rise of a loop closure, and put the robot at the height that it leads by."""
        source, target, rise = (self.rises.array(name) for name in Rises._fields)
        row = np.flatnonzero((source == revoked.source) & (target == revoked.target))
        if not len(row):
            return
        z, n = self.levels.array("z_m"), self.now
        led = z[revoked.target] - z[revoked.source] - rise[row[0]]
        n.rise_m, n.at = float(self.z_m - led - z[revoked.source]), revoked.source
        kept = torch.from_numpy(np.arange(self.rises.n) != row[0])
        self.rises.replace(**{name: self.rises[name][kept] for name in self.rises.columns})
        n.at_rest = 0

    def relax(self) -> float:
        """Reduce the residuals of the rises; return the largest correction, in metres."""
        c = self.map_config
        if self.now.at_rest or not c.loops or not self.rises.n:
            return 0.0
        z, rises = self.levels.array("z_m"), self.measured_rises
        largest = relax_heights(z, rises, c.loops, c.correction, c.rest_tolerance)
        self.now.at_rest = int(largest <= c.rest_tolerance)
        return largest

    # ----------------------------------------------------------------- protocol of a population

    def step(self, now: StepInput, observation: Observation) -> None:
        """Advance by a frame of the brain: inject by the view, settle, move by odometry."""
        self.update_from_view(now.view)
        self.integrate(now.motion, now.v_z_m_s)
        self.now.rise_m += now.v_z_m_s * now.motion.dt_s

    def decide(self, map_: LeadableMap, now: StepInput) -> Decision:
        """Create, link or set an experience by the view and the pose-cell estimate."""
        before, tracking = map_.current, now.tracking
        if tracking is not None and tracking.kind in ("link", "set"):
            self.relocalise(now.view)
        if tracking is not None and tracking.revoked is not None:
            before = tracking.revoked.source
            self._undo(tracking.revoked)
        view = now.view
        if tracking is not None and tracking.kind == "at":
            tracking, view = _settled(map_, now.motion, view, tracking)
        decision = Decision(
            *map_(
                now.motion, view, self.estimate, now.frame,
                kidnapped=now.vetoed, tracking=tracking,
            )
        )  # fmt: skip
        self._follow_map(before, decision, tracking is not None and tracking.kind == "at")
        self.relax()
        return decision

    def excludes(self) -> np.ndarray | None:
        """Return which experiences are on another storey than the robot, ``bool (n,)``."""
        if not self.levels.n:
            return None
        return np.abs(self.levels.array("z_m") - self.z_m) > self.settings.gate_m

    def belief(self, map_: LeadableMap) -> Belief:
        """Return the pose on the map; that of the cells repeats on the torus."""
        return Belief(map_.pose, 0.0, map_.current, map_.pose_table)

    def follow(self, correction: Correction) -> None:
        """Move and rotate the activity by the correction of another population."""
        if not correction.moves:
            return
        c = self.config
        dx, dy = correction.displacement(TWO_PI * self.sheet.heading_cells / c.n_theta)
        self.grid.shift(dx / c.cell_size_m, dy / c.cell_size_m, 0.0)
        self.sheet.shift(0.0, correction.turn_rad * c.n_theta / TWO_PI)

    def recorded(self) -> dict[str, np.ndarray]:
        """Return the activity of both networks, each flat."""
        return {
            "grid_3d": self.grid.activity.flatten().numpy(force=True),
            "yaw_height": self.sheet.activity.flatten().numpy(force=True),
        }

    def counts(self) -> dict[str, float]:
        """Return the extent of the heights of the map."""
        z = self.levels.array("z_m")
        return {"height_range_m": float(np.ptp(z)) if len(z) else 0.0}

    def scalars(self) -> dict[str, float]:
        """Return the activity of the most active grid cell, and the height of the robot."""
        return {"cells_3d/peak": self.grid.peak, "cells_3d/z_m": self.z_m}

    def images(self) -> dict[str, tuple[np.ndarray, ...]]:
        """Return grid activity summed over height, and over y; and that of the sheet."""
        grid, sheet = (one.activity.numpy(force=True) for one in (self.grid, self.sheet))
        return {"cells_3d/activity": (grid.sum(axis=0), grid.sum(axis=1), sheet)}

    def frame_columns(self) -> dict[str, float]:
        """Return the height of the robot, that of the cells, and that above the experience."""
        return {"z_m": self.z_m, "pose_z": self.estimate_3d.z, "rise_m": self.now.rise_m}

    def experience_columns(self) -> dict[str, np.ndarray]:
        """Return the height of every experience."""
        return {"z_m": self.levels.array("z_m")}

    def tables(self) -> dict[str, str]:
        """Return the rises between experiences."""
        rows = zip(*(column.tolist() for column in self.measured_rises), strict=True)
        return {"rises.csv": "\n".join(["from,to,rise_m", *(f"{s},{t},{r!r}" for s, t, r in rows)])
                + "\n"}  # fmt: skip

    def renumber(self, change: Renumbering) -> None:
        """Drop the bindings and heights that are not kept; lead rises to what is."""
        b, levels = self.bindings, self.levels
        ids, root = change.experiences, change.kept_experiences[change.experiences]
        rises = contract_rises(self.measured_rises, levels.array("z_m"), root)
        moved = Rises(ids[rises.source], ids[rises.target], rises.rise_m)
        self.rises.replace(**{k: torch.from_numpy(v) for k, v in moved._asdict().items()})
        b.replace(**{name: change.rows_of_views(b[name]) for name in b.columns})
        levels.replace(**{k: change.rows_of_experiences(levels[k]) for k in levels.columns})
        n = self.now
        n.view, n.at, n.at_rest = change.view(n.view), change.experience(n.at), 0

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Move the partial session on the torus and in height, and merge all tables."""
        return merge_pose_3d(loaded, partial, join, self.settings.cell_height_m, self.settings.n_z)

    def contradicts(self, loaded: State, partial: State, pairs: Pairs) -> str:
        """Say whether experiences that look the same differ in height by different amounts."""
        return differing_heights(loaded, partial, pairs, self.settings.gate_m)

    def moved_cells(
        self, loaded: State, partial: State, match: Match, config: BrainConfig
    ) -> MovedCells:
        """Move the partial session on the torus, so that the matched experiences coincide."""
        return move_session(loaded, partial, match, config, self.name)

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Yield activity, bindings, heights and rises that are invalid."""
        settings = cast(Pose3DConfig, config.section(cls.kind))
        return state_faults(state, config.pose_cells, settings.n_z, n_views, n_experiences)
