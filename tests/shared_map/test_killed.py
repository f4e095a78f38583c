"""Robots that are killed lose nothing that was acknowledged."""

import multiprocessing
import os
import random
import signal
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from neuroslam import BrainConfig
from neuroslam.shared_map import Journal, encode
from neuroslam.shared_map.fold import gather
from neuroslam.shared_map.messages import LINK
from tests.shared_map.test_messages import offer

CONFIG = BrainConfig(view={"template_width": 12, "template_height": 8, "shift_match": 1})


def whole(robot):
    rng = np.random.default_rng(robot)
    one = offer(400, seed=robot, session=1000 + robot)
    pixels = rng.integers(0, 256, (400, 96), dtype=np.uint8)
    return one._replace(pixels=pixels)


def drive(robot: int, folder: str, ledger: str) -> None:
    """Offer place after place; write down each number once it is acknowledged."""
    one = whole(robot)
    log = os.open(ledger, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with Journal(folder, CONFIG) as journal:
        for k in range(400):
            places = one.places[k : k + 1].copy()
            links = one.links[k - 1 : k] if k else np.zeros(0, LINK)
            part = one._replace(pixels=one.pixels[k : k + 1], places=places, links=links)
            journal.offer(f"r{robot}", encode(part))
            os.write(log, f"{k}\n".encode())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the robots are forked: no time to load torch")
def test_robots_killed_at_random_lose_nothing_that_was_acknowledged(tmp_path):
    with Journal(tmp_path, CONFIG):
        pass
    context = multiprocessing.get_context("fork")
    ledgers = [tmp_path / f"r{k}.txt" for k in range(4)]
    robots = [
        context.Process(target=drive, args=(k, str(tmp_path), str(ledger)))
        for k, ledger in enumerate(ledgers)
    ]
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        for robot in robots:
            robot.start()
    end = time.monotonic() + 30.0
    while not all(ledger.exists() and ledger.stat().st_size for ledger in ledgers):
        assert time.monotonic() < end
        time.sleep(0.005)
    rng = random.Random(3)
    for robot in robots:
        time.sleep(rng.uniform(0.0, 0.05))
        os.kill(robot.pid, signal.SIGKILL)
    for robot in robots:
        robot.join(10.0)
    assert any(robot.exitcode == -signal.SIGKILL for robot in robots)
    with Journal(tmp_path) as journal:
        assert journal.faults() == []
        records = gather(journal.all())
    for k, ledger in enumerate(ledgers):
        acknowledged = [int(line) for line in Path(ledger).read_text().split()]
        assert acknowledged
        assert {(1000 + k, number) for number in acknowledged} <= records.places.keys()
