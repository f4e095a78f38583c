"""A Gymnasium environment: an agent in an arena or a rendered world that observes firing rates.

Needs the extra ``gym``. Importing this module registers ``neuroslam/Navigation-v0``.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig, build_config, read_preset
from neuroslam.errors import ConfigError, SourceError
from neuroslam.geometry import wrap_angle
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Pose, Velocity
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.catalogue import build_world, catalogue
from neuroslam.worlds.render import Camera, measure_ranges, render
from neuroslam.worlds.senses import N_WALLS, REACH_M

try:
    import gymnasium  # pyright: ignore[reportMissingImports]
    from gymnasium import spaces  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ConfigError(
        f"Gymnasium cannot be imported ({error}); pip install neuroslam[gym]"
    ) from None

RADIUS_M = 0.03
"""Radius of the agent in an arena; in a rendered world it is ten times as large."""

MOST = 1e6
"""Bound of the observation space; rates are far below."""

_BEAMS = 36
_TRIES = 1000

Observation = dict[str, np.ndarray]


class NavigationEnv(gymnasium.Env[Observation, np.ndarray]):
    """An agent that is driven by speed and turn rate, and observes what its brain's cells fire.

    The observation is a dictionary: the rates of each population of the brain in its fixed order,
    ``float32``. The agent stops at walls. With a goal the reward of a step is the distance in
    metres by which the agent has come nearer, and an episode ends there; else rewards are 0.

    Args:
        place: Name of an arena (``square``) or of a rendered world (``ellipse``), or an
            :class:`~neuroslam.worlds.arena.Arena`.
        config: Of the brain; ``None``: the preset ``slrb`` in an arena, ``ratslam`` in a world.
        goal_m: Position of the goal; ``None``: no goal.
        goal_radius_m: Distance at which the goal is reached.
        max_speed_m_s: Speed of the action 1; negative actions stand still.
        max_turn_rad_s: Turn rate of the action 1.
        max_steps: Steps after which an episode is truncated.
        render_mode: ``rgb_array`` or ``None``.

    Raises:
        ConfigError: If no population of the brain has rates.
        SourceError: If there is no such place, or the goal is not in it.

    Example:
        >>> env = NavigationEnv("square", goal_m=(0.5, 0.5))
        >>> rates, _ = env.reset(seed=0)
        >>> {kind: rate.shape for kind, rate in rates.items()}
        {'place': (264,)}
        >>> _, reward, *_ = env.step(np.array([1.0, 0.0], np.float32))
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - as gymnasium has it

    def __init__(
        self,
        place: str | Arena = "square",
        config: BrainConfig | None = None,
        goal_m: tuple[float, float] | None = None,
        goal_radius_m: float = 0.1,
        max_speed_m_s: float = 0.3,
        max_turn_rad_s: float = math.pi,
        max_steps: int = 1000,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = render_mode
        is_world = isinstance(place, str) and place.removeprefix("world:") in catalogue()
        self._home = _InWorld(str(place)) if is_world else _InArena(place)
        preset = "ratslam" if is_world else "slrb"
        self.config = config or build_config(read_preset(preset), preset)
        self.goal_m = goal_m
        if goal_m is not None and not self._home.is_free(*goal_m):
            raise SourceError(
                f"goal ({goal_m[0]:g}, {goal_m[1]:g}) m is not in {self._home.name}, or too near a "
                "wall; expected a position that the agent can reach"
            )
        self.goal_radius_m, self.max_steps = goal_radius_m, max_steps
        self.max_speed_m_s, self.max_turn_rad_s = max_speed_m_s, max_turn_rad_s
        self.pose = Pose(0.0, 0.0, 0.0)
        self._dt_s, self._step = 1.0 / self.config.frame_rate_hz, 0
        self._brain = NavigationBrain(self.config)
        sizes = {
            kind: population.rates.size
            for kind, population in self._brain.populations.items()
            if population.rates is not None
        }
        if not sizes:
            raise ConfigError(
                f"cells = {list(self._brain.populations)}: none has rates to observe; expected "
                "pose, place, head_direction or another population with rates"
            )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        boxes: dict[str, spaces.Space[Any]] = {
            kind: spaces.Box(-MOST, MOST, (n,), np.float32) for kind, n in sizes.items()
        }
        self.observation_space: spaces.Space[Any] = spaces.Dict(boxes)
        self._kinds = list(sizes)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode with a new brain, at a random pose or at ``options["pose"]``.

        Raises:
            SourceError: If the given pose is not in the place.
        """
        super().reset(seed=seed)
        given = (options or {}).get("pose")
        if given is not None and not self._home.is_free(float(given[0]), float(given[1])):
            raise SourceError(f"pose {tuple(given)} is not free in {self._home.name}")
        self.pose = Pose(*map(float, given)) if given else self._home.start(self.np_random)
        self._brain, self._step = NavigationBrain(self.config), 0
        return self._observe(0.0, 0.0), self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive for one frame, then let the brain take it."""
        forward, left = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        turn = float(left) * self.max_turn_rad_s * self._dt_s
        before, length = self.pose, max(float(forward), 0.0) * self.max_speed_m_s * self._dt_s
        middle = before.theta_rad + turn / 2.0
        to = before.x_m + length * math.cos(middle), before.y_m + length * math.sin(middle)
        if not self._home.can_go(before, middle, length, to):
            length, to = 0.0, (before.x_m, before.y_m)
        self.pose = Pose(*to, wrap_angle(before.theta_rad + turn))
        self._step += 1
        rates = self._observe(length / self._dt_s, turn / self._dt_s)
        nearer, arrived = 0.0, False
        if self.goal_m is not None:
            far, near = (math.dist(at[:2], self.goal_m) for at in (before, self.pose))
            nearer, arrived = far - near, near <= self.goal_radius_m
        return rates, nearer, arrived, self._step >= self.max_steps, self._info()

    def render(self) -> np.ndarray | None:
        """Return the place from above with the agent and the goal, or the view of its camera."""
        if self.render_mode != "rgb_array":
            return None
        return self._home.picture(self.pose, self.goal_m)

    def _observe(self, v_m_s: float, w_rad_s: float) -> Observation:
        time_s = self._step * self._dt_s
        frame = Frame(self._step, time_s, velocity=Velocity(v_m_s, w_rad_s), truth=self.pose)
        with limit_threads(1):
            self._brain(self._home.sensed(frame, self.pose))
        populations = self._brain.populations
        return {
            kind: np.asarray(populations[kind].rates, np.float32).ravel() for kind in self._kinds
        }

    def _info(self) -> dict[str, Any]:
        return {"pose": self.pose, "lost": any(p.lost for p in self._brain.populations.values())}


class _InArena:
    """An arena, whose walls and a compass are sensed."""

    def __init__(self, place: str | Arena) -> None:
        self.arena = (
            place if isinstance(place, Arena) else named_arena(place.removeprefix("arena:"))
        )
        self.name = self.arena.name

    def is_free(self, x_m: float, y_m: float) -> bool:
        at = np.array([[x_m, y_m]])
        return bool(self.arena.contains(at)[0] and self.arena.clearance(at)[0] >= RADIUS_M)

    def start(self, generator: np.random.Generator) -> Pose:
        left, right, low, high = self.arena.bounds
        for _ in range(_TRIES):
            x, y = generator.uniform([left, low], [right, high]).tolist()
            if self.is_free(x, y):
                return Pose(x, y, float(generator.uniform(-math.pi, math.pi)))
        raise SourceError(f"{self.name}: no position is {RADIUS_M:g} m from its walls")

    def can_go(self, pose: Pose, heading: float, length: float, to: tuple[float, float]) -> bool:
        if not self.is_free(*to):
            return False
        at = np.array([[pose.x_m, pose.y_m]])
        return bool(self.arena.ranges(at, [heading], 1, math.inf)[0, 0] > length)

    def sensed(self, frame: Frame, pose: Pose) -> Frame:
        distance, bearing = self.arena.nearest_walls([pose[:2]], REACH_M, N_WALLS)
        walls = np.column_stack([distance[0], bearing[0] - pose.theta_rad])
        walls = walls[np.isfinite(walls[:, 0])]
        return frame._replace(walls=walls, heading_rad=pose.theta_rad)

    def picture(self, pose: Pose, goal_m: tuple[float, float] | None) -> np.ndarray:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4, 4), dpi=64)
        canvas, axes = FigureCanvasAgg(figure), figure.add_axes((0.02, 0.02, 0.96, 0.96))
        for line in self.arena.outlines:
            axes.plot(*np.asarray(line).T, color="0.3", linewidth=3)
        if goal_m is not None:
            axes.plot(*goal_m, "o", color="tab:green", markersize=12)
        nose = (
            pose.x_m + 0.08 * math.cos(pose.theta_rad),
            pose.y_m + 0.08 * math.sin(pose.theta_rad),
        )
        axes.plot([pose.x_m, nose[0]], [pose.y_m, nose[1]], color="tab:red", linewidth=3)
        axes.plot(pose.x_m, pose.y_m, "o", color="tab:red", markersize=8)
        axes.set_aspect("equal")
        axes.axis("off")
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


class _InWorld:
    """A rendered world, which a camera shows."""

    def __init__(self, place: str) -> None:
        self.name = place
        self.world = build_world(place.removeprefix("world:"))
        sense = self.world.sense
        self.camera = Camera(
            width=256 if sense.panoramic else 160,
            height=64 if sense.panoramic else 80,
            panoramic=sense.panoramic,
            camera_height_m=sense.camera_height_m,
            horizon=sense.horizon,
        )

    def _nearest(self, pose: Pose) -> np.ndarray:
        return measure_ranges(self.world, pose, _BEAMS, self.camera.camera_height_m)

    def is_free(self, x_m: float, y_m: float) -> bool:
        return bool(self._nearest(Pose(x_m, y_m, 0.0)).min() >= 10.0 * RADIUS_M)

    def start(self, generator: np.random.Generator) -> Pose:
        route = self.world.routes[0]
        return Pose(*route.at(generator.uniform(0.0, route.length_m))[0].tolist())

    def can_go(self, pose: Pose, heading: float, length: float, to: tuple[float, float]) -> bool:
        ahead = self._nearest(Pose(pose.x_m, pose.y_m, heading))[0]
        return bool(ahead > length) and self.is_free(*to)

    def sensed(self, frame: Frame, pose: Pose) -> Frame:
        return frame._replace(image=render(self.world, pose, self.camera))

    def picture(self, pose: Pose, goal_m: tuple[float, float] | None) -> np.ndarray:
        return render(self.world, pose, self.camera)


gymnasium.register("neuroslam/Navigation-v0", entry_point="neuroslam.adapters.gym:NavigationEnv")
