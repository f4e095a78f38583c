"""The robot of ``examples/live_robot.py`` in real time order: ``-m benchmarks.bench_live_robot``.

Pictures come at 30 per second of the wall clock; one that is not taken in time waits, and is
counted as late. The first day maps the route; on the next day the robot is found on the stored map
and drives to goals. The time of a step is that of ``LiveRobot.step`` with ``steer``, without
rendering; its CPU time is that of all threads, and does not depend on what else runs.
"""

import argparse
import importlib.util
import math
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import cv2
import numpy as np
import torch

from neuroslam.runs.live import LiveRobot
from neuroslam.types import Velocity
from neuroslam.worlds.world import open_world

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "live_robot.py"
WARM = 30  # first steps, which load compiled code, before the robot moves


class Day(NamedTuple):
    """What a day took.

    Attributes:
        steps: Number of steps.
        wall_ms: Median, 99th percentile and largest time of a step.
        cpu_ms: The same in CPU time.
        late: Steps that ended after the next picture had come.
        said: Other figures.
    """

    steps: int
    wall_ms: tuple[float, ...]
    cpu_ms: tuple[float, ...]
    late: int
    said: str = ""


class Clock:
    """Delivers pictures at the rate of the camera, and keeps the times of the steps.

    Args:
        live: The robot's brain.
        rate_hz: Pictures per second.
        paced: Wait for the time of each picture.
    """

    def __init__(self, live: LiveRobot, rate_hz: float, paced: bool) -> None:
        self.live, self.period_s, self.paced = live, 1.0 / rate_hz, paced
        self.times: list[tuple[float, float]] = []
        self.late, self._next_s, self._frames = 0, time.perf_counter(), 0

    def step(
        self, picture: np.ndarray, wheels: tuple[float, float], steered: tuple[float, float] | None
    ) -> Velocity | None:
        """Take one picture; return the next command if it is to steer: speed, look-ahead."""
        if self.paced:
            time.sleep(max(0.0, self._next_s - time.perf_counter()))
        self._next_s = max(self._next_s, time.perf_counter() - self.period_s) + self.period_s
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        self.live.step(picture, self._frames * self.period_s, wheels)
        command = None if steered is None else self.live.steer(*steered)
        spent = time.perf_counter() - wall_s, time.process_time() - cpu_s
        self._frames += 1
        if self._frames > WARM:
            self.times.append(spent)
            self.late += spent[0] > self.period_s
        return command

    def day(self, said: str = "") -> Day:
        """Return the figures of the day."""
        times = 1e3 * np.array(self.times)
        figures = np.vstack([np.quantile(times, [0.5, 0.99], axis=0), times.max(axis=0)]).T
        return Day(len(times), *(tuple(row) for row in figures.tolist()), self.late, said)


def days(example: ModuleType, goals: int, paced: bool) -> dict[str, Day]:
    """Drive both days."""
    world = open_world(example.WORLD)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.safetensors"
        robot = example.Robot(world)
        with LiveRobot(example.config(), path) as live:
            clock = Clock(live, example.RATE_HZ, paced)
            for frame in range(world.n_frames):
                clock.step(*robot.drive(robot.by_hand(frame)), None)
            found = {"first day": clock.day(f"{live.brain.map.n} experiences")}
        return found | {"next day": next_day(example, path, goals, paced)}


def next_day(example: ModuleType, path: Path, goals: int, paced: bool, start: int = 120) -> Day:
    """Find the robot on the stored map, then drive to goals."""
    world, joined = open_world(example.WORLD), []
    robot = example.Robot(world, seed=1)
    robot.pose = world.truth(start)
    live = LiveRobot(path=path, on_event=lambda event: joined.append(event.kind == "joined"))
    clock, frames = Clock(live, example.RATE_HZ, paced), 0
    while not any(joined) and frames < 400:
        frames += 1
        clock.step(*robot.drive(robot.by_hand(start + frames)), None)
    truths = world.truths()
    speed = math.hypot(*np.diff(truths[:2, :2], axis=0)[0]) * example.RATE_HZ
    chosen, reached = np.random.default_rng(1), 0
    for _ in range(goals):
        goal = int(chosen.choice(live.reachable()))
        true = world.truth(int(live.brain.map.experiences["first_frame"][goal]))
        live.add_goal(goal)
        command = live.steer(speed, example.LOOK_AHEAD_M)
        for _ in range(1500):
            if command is None:
                break
            command = clock.step(*robot.drive(command), (speed, example.LOOK_AHEAD_M))
        apart = math.hypot(robot.pose.x_m - true.x_m, robot.pose.y_m - true.y_m)
        reached += command is None and apart < 0.75
    return clock.day(f"joined after {frames} frames; {reached} of {goals} goals reached")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--fast", action="store_true", help="do not wait for the camera")
    words = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    spec = importlib.util.spec_from_file_location("live_robot", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    print("| day | steps | wall ms: median, p99, largest | CPU ms: the same | late | |")
    print("|---|---|---|---|---|---|")
    for name, day in days(example, words.goals, not words.fast).items():
        wall, cpu = (", ".join(f"{ms:.1f}" for ms in each) for each in (day.wall_ms, day.cpu_ms))
        print(f"| {name} | {day.steps} | {wall} | {cpu} | {day.late} | {day.said} |")


if __name__ == "__main__":
    main()
