"""Processes of the experiment ``live-fleet``: robots that are killed, watched, and a hundred."""

import os
import random
import shutil
import signal
import time
from contextlib import suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import SharedMapError
from neuroslam.runs.live_map import EVERY_S, FoldThread
from neuroslam.sensors import open_source
from neuroslam.shared_map.fold import gather
from neuroslam.shared_map.journal import Journal
from neuroslam.shared_map.robot import LiveRobot
from neuroslam.threads import limit_threads
from neuroslam.types import Frame
from neuroslam.workers import worker_context

RING = "world:ellipse?noise=0.01&width=128&height=32&frames_per_lap=200"
"""World of the processes: small pictures, so that two cores have many robots."""

POLL_S = 0.25
"""Pause between two looks of a robot at the offers of others."""


def _started(target: Any, arguments: list[tuple[Any, ...]]) -> list[BaseProcess]:  # noqa: ANN401
    context: Any = worker_context()
    robots: list[BaseProcess] = [context.Process(target=target, args=one) for one in arguments]
    for robot in robots:
        robot.start()
    return robots


def _emptied(folder: Path) -> Path:
    """Return a folder for a journal, without that of an earlier experiment."""
    shutil.rmtree(folder, ignore_errors=True)
    return folder


def _write_down(ledger: Path, text: str) -> None:
    with ledger.open("a", encoding="utf-8") as file:
        file.write(text + "\n")
        file.flush()


# --- killed -------------------------------------------------------------------------------------


def _drive_until_killed(number: int, folder: Path, ledger: Path) -> None:
    """Map round after round, and write down each place once it was acknowledged."""
    with limit_threads(), torch.inference_mode(), Journal(folder, BrainConfig()) as journal:
        brain = NavigationBrain(BrainConfig())
        robot = LiveRobot(journal, brain, f"robot {number}")
        for frame in open_source(f"{RING}&laps=5&start={number / 10}&seed={number}").frames():
            brain(frame)
            if robot.offer():
                table = brain.map.experiences
                rows = zip(table.array("session"), table.array("number"), strict=True)
                for session, place in list(rows)[-3:]:
                    _write_down(ledger, f"{session} {place}")


def killed_robots(out: Path, n: int = 10, seed: int = 0) -> dict[str, Any]:
    """Kill robots with SIGKILL at random while they map; count what the journal has lost.

    Args:
        out: Folder for the journal and the ledgers.
        n: Robots.
        seed: Of the order and the times of the kills.
    """
    folder = _emptied(out / "killed")
    with Journal(folder, BrainConfig()):
        pass
    ledgers = [out / f"killed_{k}.txt" for k in range(n)]
    for ledger in ledgers:
        ledger.unlink(missing_ok=True)
    robots = _started(
        _drive_until_killed, [(k, folder, ledger) for k, ledger in enumerate(ledgers)]
    )
    end, rng = time.monotonic() + 180.0, random.Random(seed)
    while time.monotonic() < end and not all(ledger.is_file() for ledger in ledgers):
        time.sleep(0.05)
    for robot in rng.sample(robots, n):
        time.sleep(rng.uniform(0.0, 0.5))
        if robot.pid is not None:
            os.kill(robot.pid, signal.SIGKILL)
    for robot in robots:
        robot.join(30.0)
    with Journal(folder) as journal:
        faults = journal.faults()
        places = gather(journal.all()).places
    acknowledged = {
        (int(words[0]), int(words[1]))
        for ledger in ledgers
        if ledger.is_file()
        for words in (line.split() for line in ledger.read_text().splitlines())
        if len(words) == 2
    }
    for ledger in ledgers:
        ledger.unlink(missing_ok=True)
    return {
        "robots_killed": sum(robot.exitcode == -signal.SIGKILL for robot in robots),
        "places_acknowledged": len(acknowledged),
        "places_lost": len(acknowledged - places.keys()),
        "faults_of_the_journal": len(faults),
    }


# --- until a place is usable --------------------------------------------------------------------


def _drive_in_time(number: int, folder: Path, begin_s: float, ledger: Path) -> None:
    """Map half a ring at once, then go on at 10 frames a second, and note when places are made."""
    with limit_threads(), torch.inference_mode(), Journal(folder, BrainConfig()) as journal:
        brain = NavigationBrain(BrainConfig())
        robot = LiveRobot(journal, brain, f"robot {number}")
        frames = list(open_source(f"{RING}&laps=0.75&start={0.25 * number}&seed={number}").frames())
        known, offered = 0, 0.0
        for frame in frames:
            if frame.index == len(frames) * 2 // 3:
                robot.offer()
                known = brain.map.n
                time.sleep(max(0.0, begin_s - time.time()))
            brain(frame)
            if frame.index < len(frames) * 2 // 3:
                continue
            for place in range(known, brain.map.n):
                session = brain.map.state.session
                _write_down(ledger, f"{session} {place} {time.time()}")
            known = brain.map.n
            if time.monotonic() - offered >= EVERY_S:
                robot.offer()
                offered = time.monotonic()
            time.sleep(0.1)
        robot.offer()


def seconds_until_usable(out: Path, lead_s: float = 30.0) -> np.ndarray:
    """Measure the time from when a robot makes a place until another can recognise it.

    Two robots in processes of their own map; a third, here, looks at the journal every
    :data:`POLL_S` seconds. A place counts when it lies on the third one's copy of the shared map
    and the template is there to be matched.

    Args:
        out: Folder for the journal and the ledgers.
        lead_s: Seconds until the robots go on in time, after they have mapped half a ring.

    Returns:
        Seconds of each place.
    """
    folder, ledgers = _emptied(out / "usable"), [out / f"usable_{k}.txt" for k in range(2)]
    for ledger in ledgers:
        ledger.unlink(missing_ok=True)
    begin_s = time.time() + lead_s
    with Journal(folder, BrainConfig()) as journal:
        robots = _started(
            _drive_in_time, [(k, folder, begin_s, ledger) for k, ledger in enumerate(ledgers)]
        )
        folding = FoldThread(folder)
        folding.start()
        third = LiveRobot(journal, NavigationBrain(BrainConfig()), "third")
        usable: dict[tuple[int, int], float] = {}
        while any(robot.is_alive() for robot in robots) and time.time() < begin_s + 120.0:
            with suppress(SharedMapError):  # until the first fold
                if third.take() and third.map.view.n:
                    now = time.time()
                    for key in third.placed:
                        usable.setdefault(key, now)
            time.sleep(POLL_S)
        folding.stop()
        for robot in robots:
            robot.join(10.0)
    took = []
    for ledger in ledgers:
        for line in ledger.read_text().splitlines() if ledger.is_file() else ():
            session, number, made = line.split()
            seen = usable.get((int(session), int(number)))
            if seen is not None:
                took.append(seen - float(made))
        ledger.unlink(missing_ok=True)
    return np.array(took)


# --- a hundred ----------------------------------------------------------------------------------


def _drive_many(numbers: range, folder: Path, seconds: int, to: Any) -> None:  # noqa: ANN401
    """Step robots once a second each, one after the other; report lateness and processor time."""
    with limit_threads(), torch.inference_mode(), Journal(folder, BrainConfig()) as journal:
        robots, frames = [], list[list[Frame]]()
        for number in numbers:
            source = f"{RING}&laps=1&start={number / 100}&seed={number}"
            frames.append(list(open_source(source).frames(stop=seconds)))
            robots.append(LiveRobot(journal, NavigationBrain(BrainConfig()), f"robot {number}"))
        began, cpu, late = time.monotonic(), time.process_time(), []
        for second in range(seconds):
            time.sleep(max(0.0, began + second - time.monotonic()))
            for robot, own in zip(robots, frames, strict=True):
                robot.brain(own[second])
                if second % 2:
                    robot.offer()
            late.append(time.monotonic() - began - second)
        to.put((time.process_time() - cpu, max(late), sum(robot.n_offered for robot in robots)))


def hundred_robots(out: Path, n: int = 100, seconds: int = 20) -> dict[str, Any]:
    """Run robots at one frame a second, on two processes; measure whether these keep up.

    Args:
        out: Folder for the journal.
        n: Robots.
        seconds: Duration.
    """
    folder = _emptied(out / "hundred")
    with Journal(folder, BrainConfig()):
        pass
    context: Any = worker_context()
    answers: Any = context.Queue()
    halves = [range(0, n // 2), range(n // 2, n)]
    robots = _started(_drive_many, [(half, folder, seconds, answers) for half in halves])
    found = [answers.get(timeout=300.0) for _ in robots]
    for robot in robots:
        robot.join(30.0)
    with Journal(folder) as journal:
        entries = journal.all()
    return {
        "robots_at_once": n,
        "frames_a_second_and_robot": 1.0,
        "cpu_cores_used": sum(row[0] for row in found) / seconds,
        "slowest_round_s": max(row[1] for row in found),
        "places_of_all": sum(row[2] for row in found),
        "offers_of_all": len(entries),
    }
