"""A robot's own loop in a rendered world: it maps on the first day, and drives on the second.

Replace ``Robot`` by your camera, wheels and motors; everything else stays::

    python examples/live_robot.py map.safetensors --goals 20
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np

from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.geometry import compose, relative_poses
from neuroslam.runs.live import Event, LiveRobot, Timing
from neuroslam.types import Pose, Velocity
from neuroslam.worlds.render import measure_ranges, render
from neuroslam.worlds.world import WorldSource, open_world

WORLD = "world:corridor?width=80&height=60&frames_per_lap=440&laps=3"
RATE_HZ = 30.0
LOOK_AHEAD_M = 0.6
RADIUS_M = 0.2


class Robot:
    """A camera on wheels in a rendered world; the wheels measure 2 % too much, with noise.

    Walls stop it: the wheels stall, and measure nothing.

    Args:
        world: Its world and the route that a person drives.
        seed: Seed of the noise.
    """

    def __init__(self, world: WorldSource, seed: int = 0) -> None:
        self.world, self.pose = world, world.truth(0)
        self._noise = np.random.default_rng(seed)

    def drive(self, command: Velocity) -> tuple[np.ndarray, tuple[float, float]]:
        """Drive for one period; return the picture and what the wheels measured."""
        way, turn = command.v_m_s / RATE_HZ, command.w_rad_s / RATE_HZ
        step = Pose(way * math.cos(0.5 * turn), way * math.sin(0.5 * turn), turn)
        moved = compose(self.pose, step)
        blocked = measure_ranges(self.world.world, moved, 24, 0.3).min() < RADIUS_M
        if blocked:  # by a wall: the wheels stall, turning is free
            way, moved = 0.0, self.pose._replace(theta_rad=moved.theta_rad)
        self.pose = moved
        v, w = 1.02 + 0.02 * self._noise.standard_normal(2)
        picture = render(self.world.world, self.pose, self.world.camera)
        return picture, (way * RATE_HZ * v, command.w_rad_s * w)

    def by_hand(self, frame: int) -> Velocity:
        """Return the command that drives the robot to where the route is in a frame."""
        step = relative_poses(np.array(self.pose), np.array(self.world.truth(frame)))
        way = math.copysign(math.hypot(step[0], step[1]), step[0])
        return Velocity(way * RATE_HZ, float(step[2]) * RATE_HZ)


def config() -> BrainConfig:
    """Return the settings: views of sequences, and the rate of the camera."""
    return build_config(merge_values(read_preset("auto"), {"frame_rate_hz": RATE_HZ}))


def first_day(path: Path, on_event: object = print) -> Timing:
    """Map the route, driven by hand; the map is saved on exit, also on Ctrl-C."""
    world = open_world(WORLD)
    robot = Robot(world)
    with LiveRobot(config(), path, on_event if callable(on_event) else None) as live:
        for frame in range(world.n_frames):
            picture, wheels = robot.drive(robot.by_hand(frame))
            live.step(picture, time_s=frame / RATE_HZ, velocity=wheels)
        return live.timing


def next_day(
    path: Path, goals: int, start: int = 120, on_event: object = print, pushed_m: float = 0.0
) -> tuple[int, int, Timing]:
    """Find the robot on the stored map, then drive to goals that the robot chooses.

    Args:
        path: The stored map.
        goals: Number of goals, experiences of the first day.
        start: Frame of the route where the robot wakes up; it does not know it.
        on_event: Called with each event.
        pushed_m: How far a person pushes the robot to its left, and turns it by 0.3 rad, before
            every second goal.

    Returns:
        Frames until it was found, goals that were reached, times of the steps.
    """
    world = open_world(WORLD)
    robot, events = Robot(world, seed=1), list[Event]()
    robot.pose = world.truth(start)
    live = LiveRobot(path=path, on_event=events.append)
    woke_s, found = time.time(), 0  # another clock than yesterday's

    def step(command: Velocity) -> None:
        nonlocal found
        picture, wheels = robot.drive(command)
        found += 1
        live.step(picture, time_s=woke_s + found / RATE_HZ, velocity=wheels)

    while not any(event.kind == "joined" for event in events) and found < 400:
        step(robot.by_hand(start + found))
    frames = found
    speed = math.hypot(*np.diff(world.truths()[:2, :2], axis=0)[0]) * RATE_HZ
    chosen, reached = np.random.default_rng(1), 0
    for number in range(goals):
        if number % 2 and pushed_m:
            robot.pose = compose(robot.pose, Pose(0.0, pushed_m, 0.3))
        goal = int(chosen.choice(live.reachable()))
        true = world.truth(int(live.brain.map.experiences["first_frame"][goal]))
        live.add_goal(goal)
        for _ in range(1500):  # two laps, and time to look around
            command = live.steer(speed, LOOK_AHEAD_M)
            if command is None:  # reached
                break
            step(command)
        waiting = live.brain.map.goals
        left = waiting.n
        waiting.replace(**{name: waiting[name][:0] for name in waiting.columns})
        reached += (
            not left and math.hypot(robot.pose.x_m - true.x_m, robot.pose.y_m - true.y_m) < 0.75
        )
    if callable(on_event):
        for event in events:
            on_event(event)
    return frames, reached, live.timing


def main() -> None:
    """Map, sleep, wake up, drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("map", type=Path, help="file of the map")
    parser.add_argument("--goals", type=int, default=3)
    parser.add_argument("--push", type=float, default=0.0, help="metres, before every second goal")
    words = parser.parse_args()
    print("first day:", first_day(words.map))
    frames, reached, timing = next_day(words.map, words.goals, pushed_m=words.push)
    print(f"next day: found after {frames} frames, {reached} of {words.goals} goals; {timing}")


if __name__ == "__main__":
    main()
