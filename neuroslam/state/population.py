"""What every part of a brain must say: how its states from two sessions become one."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import wraps
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.geometry import wrap_angle, wrap_angles
from neuroslam.types import Pose

P = ParamSpec("P")
T = TypeVar("T")

State = dict[str, Tensor]
"""A ``state_dict``, or the part of one that belongs to a population, without its prefix."""


class Join(NamedTuple):
    """How ids and coordinates of a partial map become those of the map it is merged into.

    Attributes:
        views: Partial view id -> merged view id, ``(n_views,)``.
        experiences: Partial experience id -> merged experience id, ``(n_experiences,)``.
        view_turns_rad: Heading with which a partial view was learnt, minus that of the merged
            view, ``(n_views,)``; 0 where the view is kept.
        turns_rad: The same of the partial experiences' headings, ``(n_experiences,)``.
        n_views: Views of the loaded map: kept partial views follow them.
        n_experiences: Experiences of the loaded map.
        torus: ``(n_x, n_y, n_theta)`` of the pose cells.
        cell_shift: By how many cells the activity moves along x, y and theta.
        view_cells: Where partial views are bound then, x, y, theta in cells, ``(n_views, 3)``.
        experience_cells: The same of the partial experiences, ``(n_experiences, 3)``.
        pivot: Pose of the matched experience in the partial map.
        onto: Pose that it takes in the merged map.
        cells: The same two poses in the frames of cells that keep positions themselves, where
            those are not the maps'.
    """

    views: np.ndarray
    experiences: np.ndarray
    view_turns_rad: np.ndarray
    turns_rad: np.ndarray
    n_views: int
    n_experiences: int
    torus: tuple[int, int, int]
    cell_shift: tuple[float, float, float]
    view_cells: np.ndarray
    experience_cells: np.ndarray
    pivot: Pose
    onto: Pose
    cells: tuple[Pose, Pose] | None = None

    @property
    def rotation_rad(self) -> float:
        """By how much the partial map turns."""
        return wrap_angle(self.onto.theta_rad - self.pivot.theta_rad)

    @property
    def kept_views(self) -> np.ndarray:
        """Ids of the partial views that are new in the merged map, in order."""
        return np.flatnonzero(self.views >= self.n_views)

    @property
    def kept_experiences(self) -> np.ndarray:
        """Ids of the partial experiences that are new in the merged map, in order."""
        return np.flatnonzero(self.experiences >= self.n_experiences)

    def place(self, poses: np.ndarray) -> np.ndarray:
        r"""Move partial poses into the loaded map; the pivot comes to lie exactly ``onto``.

        .. math:: x' = R(\Delta\theta)\,(x - x_z) + x_u, \quad
                  \theta' = (\theta - \theta_z) + \theta_u

        (Multisession RatSLAM, Eqs. 13 and 14; Eq. 14 is misprinted there, this is what its
        program does.)

        Args:
            poses: x, y in metres and heading in radians, ``(n, 3)``.

        Example:
            >>> none, torus = np.empty(0, dtype=np.int64), (9, 9, 9)
            >>> pivot, onto = Pose(1.0, 0.0, 0.0), Pose(5.0, 5.0, np.pi / 2)
            >>> join = Join(*[none] * 4, 0, 0, torus, (0, 0, 0), *[none] * 2, pivot, onto)
            >>> join.place(np.array([[2.0, 0.0, 0.0]])).round(9).tolist()
            [[5.0, 6.0, 1.570796327]]
        """
        turned = wrap_angles(poses[:, 2] - self.pivot.theta_rad + self.onto.theta_rad)
        return np.column_stack([_moved(poses[:, :2], self.pivot, self.onto), turned])

    @property
    def cells_turn_rad(self) -> float:
        """By how much positions turn that partial cells keep."""
        pivot, onto = self.cells or (self.pivot, self.onto)
        return wrap_angle(onto.theta_rad - pivot.theta_rad)

    def place_cells(self, points_m: np.ndarray) -> np.ndarray:
        """Move positions that partial cells keep, ``(n, 2)``, into the loaded cells' frame."""
        return _moved(points_m, *(self.cells or (self.pivot, self.onto)))


def _moved(points_m: np.ndarray, pivot: Pose, onto: Pose) -> np.ndarray:
    """Turn points about a pose and move them, so that it comes to lie onto another."""
    turn = onto.theta_rad - pivot.theta_rad
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = points_m[:, 0] - pivot.x_m, points_m[:, 1] - pivot.y_m
    return np.column_stack([c * dx - s * dy + onto.x_m, s * dx + c * dy + onto.y_m])


class Population(nn.Module, ABC):
    """A part of the brain that says how it merges.

    A brain is made of these alone, so that no state can be forgotten when two brains merge.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_load_state_dict_pre_hook(_make_writable)

    @staticmethod
    @abstractmethod
    def merged(loaded: State, partial: State, join: Join) -> State:
        """Merge two states of this population into one; neither is altered.

        Args:
            loaded: State of the map that is merged into.
            partial: State of the session that goes on.
            join: How the partial one's ids and coordinates change.

        Returns:
            A state with the same names.
        """

    def __setattr__(self, name: str, value: object) -> None:
        """Replace a buffer at once: torch checks it anew each time, which costs more than a step.

        Anything else is left to torch.
        """
        buffers = self.__dict__.get("_buffers")
        if buffers is not None and type(value) is Tensor and name in buffers:
            buffers[name] = value
        else:
            super().__setattr__(name, value)


def without_gradients(step: Callable[P, T]) -> Callable[P, T]:
    """Let a step run in inference mode; one that does so already loses no time by it."""

    @wraps(step)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.is_inference_mode_enabled():
            return step(*args, **kwargs)
        with torch.inference_mode():
            return step(*args, **kwargs)

    return run


def _make_writable(module: nn.Module, *_unused: object) -> None:
    """Replace what was made in inference mode, which torch would not let a state be copied into."""
    for name, buffer in module._buffers.items():
        if buffer is not None and buffer.is_inference():
            module._buffers[name] = buffer.clone()
    for name, parameter in module._parameters.items():
        if parameter is not None and parameter.is_inference():
            module._parameters[name] = nn.Parameter(parameter.clone())


class Running(Population):
    """A population whose state is only about now: the session that goes on keeps its own."""

    @staticmethod
    def merged(_loaded: State, partial: State, _join: Join) -> State:
        """Return the partial one's state."""
        return dict(partial)


def renamed(number: Tensor, ids: np.ndarray) -> Tensor:
    """Look a number up in a table of ids; negative ones mean none, and stay.

    Example:
        >>> renamed(torch.tensor(1), np.array([5, 7])).item()
        7
    """
    old = int(number)
    return number if old < 0 else number.new_tensor(int(ids[old]))
