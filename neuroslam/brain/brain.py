"""The brain: odometry, view, pose cells and map, composed; one frame in, one result out."""

import math

import torch
from torch import nn

from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.geometry import compose
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.storage import Scalars
from neuroslam.types import (
    NO_TEMPLATE,
    Frame,
    Motion,
    Pose,
    StepResult,
    Velocity,
    ViewMatch,
)
from neuroslam.view.templates import LocalViewCells

BLIND = ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)


class NavigationBrain(nn.Module):
    """RatSLAM: a stream of frames becomes a map of places.

    Each stage is a module that can be used alone: ``odometry``, ``view``, ``pose_cells`` and
    ``map``. ``state_dict`` holds everything: a brain that is saved, loaded and goes on is
    bit-equal to one that never stopped.

    Args:
        config: Every parameter; the defaults suit a forward camera on a small robot.

    Example:
        >>> from neuroslam.types import Frame, Velocity
        >>> brain = NavigationBrain(BrainConfig())
        >>> picture = torch.arange(160 * 120).reshape(120, 160).to(torch.uint8).numpy()
        >>> brain(Frame(0, 0.0, picture, Velocity(0.5, 0.0))).action
        'create'
    """

    def __init__(self, config: BrainConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or BrainConfig()
        cells = config.pose_cells
        self.odometry = VisualOdometry(config.odometry)
        self.view = LocalViewCells(config.view)
        self.pose_cells = PoseCellNetwork(cells)
        self.map = ExperienceMap(
            config.map, (cells.n_xy, cells.n_xy, cells.n_theta), cells.create_threshold_cells
        )
        self.clock = Scalars(frame=-1, time_s=0.0, frames_seen=0, after_gap_s=-math.inf)

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
            motion = Motion(*self._velocity(frame, dt_s), dt_s)
            view = BLIND if frame.image is None else self.view(frame.image)
        except BadFrame as fault:
            raise BadFrame(f"frame {frame.index}: {fault}") from None
        cells = self.pose_cells(motion, view)
        action, experience = self.map(motion, view, cells, frame.index)
        self.clock.frame, self.clock.time_s = frame.index, float(frame.time_s)
        self.clock.frames_seen += 1
        self.clock.after_gap_s = -math.inf
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
        )

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
        if not self.clock.frames_seen:
            return 1.0 / self.config.frame_rate_hz
        dt_s = frame.time_s - self.clock.time_s
        if not dt_s > 0.0:  # NaN too
            raise BadFrame(
                f"time {frame.time_s:g} s does not follow {self.clock.time_s:g} s "
                f"of frame {self.clock.frame}; times must rise"
            )
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
            if not all(map(math.isfinite, frame.velocity)):
                v, w = frame.velocity
                raise BadFrame(f"odometry v = {v:g} m/s, w = {w:g} rad/s; expected finite numbers")
            return Velocity(*map(float, frame.velocity))
        if use == "given" or frame.image is None:
            raise BadFrame(
                "no odometry in the source"
                + ("; set odometry.use to 'visual'" if use == "given" else " and no image")
            )
        return self.odometry(frame.image, dt_s)
