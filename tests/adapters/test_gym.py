import math

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym")

import gymnasium
from gymnasium.utils.env_checker import check_env

from neuroslam.adapters.gym import NavigationEnv
from neuroslam.config import BrainConfig
from neuroslam.errors import SourceError

AHEAD = np.array([1.0, 0.0], np.float32)


@pytest.mark.parametrize("place", ["square", "world:ellipse"])
def test_check_env_passes_in_arenas_and_in_worlds(place):
    cells = ["pose"] if place.startswith("world") else ["place", "head_direction"]
    config = BrainConfig(cells=cells, pose_cells={"n_xy": 7, "n_theta": 12})
    made = gymnasium.make("neuroslam/Navigation-v0", place=place, config=config)
    check_env(made.unwrapped)


def test_the_registered_name_makes_the_environment():
    env = gymnasium.make("neuroslam/Navigation-v0", place="circle1m", max_steps=3)
    env.reset(seed=1)
    ended = [env.step(AHEAD)[2:4] for _ in range(3)]
    assert ended == [(False, False), (False, False), (False, True)]


def test_the_observation_is_what_the_populations_of_the_brain_fire():
    env = NavigationEnv("square", BrainConfig(cells=["place", "head_direction"]))
    rates, _ = env.reset(seed=0, options={"pose": (0.9, 0.0, 0.0)})
    for _ in range(20):
        rates, *_, info = env.step(np.array([0.0, 0.5], np.float32))
    assert rates["head_direction"].shape == (120,)
    turned = 20 * 0.5 * math.pi / env.config.frame_rate_hz
    assert info["pose"].theta_rad == pytest.approx(turned)
    assert rates["head_direction"].argmax() * 3.0 == pytest.approx(math.degrees(turned), abs=3.0)
    assert rates["place"][:168].max() > 0.0  # a wall is 0.1 m away


def test_reward_is_the_distance_won_towards_the_goal_and_walls_stop_the_agent():
    env = NavigationEnv("square", goal_m=(0.8, 0.0), goal_radius_m=0.05)
    env.reset(seed=0, options={"pose": (0.7, 0.0, 0.0)})
    won, arrived, n = 0.0, False, 0
    while not arrived:
        _, reward, arrived, _, info = env.step(AHEAD)
        won, n = won + reward, n + 1
    assert n == math.ceil(0.05 / (0.3 / env.config.frame_rate_hz) - 1e-9)
    assert won == pytest.approx(info["pose"].x_m - 0.7)
    for _ in range(40):
        *_, info = env.step(AHEAD)
    assert 0.95 < info["pose"].x_m <= 0.97  # the wall is at 1 m, the agent's radius 3 cm


def test_goals_and_poses_in_a_wall_are_refused():
    with pytest.raises(SourceError, match=r"goal \(2, 0\) m is not in square"):
        NavigationEnv("square", goal_m=(2.0, 0.0))
    with pytest.raises(SourceError, match="is not free in square"):
        NavigationEnv("square").reset(options={"pose": (1.0, 0.0, 0.0)})
