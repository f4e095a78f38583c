"""How everything here is timed: CPU time of one thread, median of several rounds.

Machines differ and are noisy. So a time is also given in Y, the yardstick: the time in which this
machine sorts 100 000 numbers, measured in the same minutes.
"""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Row(NamedTuple):
    """A line of the table.

    Attributes:
        step: What was timed.
        size: At which size.
        ms: Our time.
        target: Largest time that we want, in words.
        beside: What others took in the same call; of C++ OpenRatSLAM in Y, from another machine.
        more: Other figures.
    """

    step: str
    size: str
    ms: float
    target: str = ""
    beside: str = ""
    more: str = ""


def cpu_ms(call: Callable[[], object], calls: int, rounds: int = 7) -> float:
    """Median CPU milliseconds of one call, over rounds of so many calls, after a warm-up."""
    call()
    times = []
    for _ in range(rounds):
        began = time.process_time()
        for _ in range(calls):
            call()
        times.append((time.process_time() - began) / calls * 1e3)
    return statistics.median(times)


def yardstick_ms() -> float:
    """Y: milliseconds in which a stable sort of 100 000 random numbers is done here."""
    numbers = np.random.default_rng(0).random(100_000)
    return cpu_ms(lambda: np.sort(numbers, kind="stable"), 3, 15)


def written(ms: float) -> str:
    """Write a time with three digits in its unit."""
    if ms >= 1000.0:
        return f"{ms / 1e3:.3g} s"
    return f"{ms:.3g} ms" if ms >= 0.1 else f"{ms * 1e3:.3g} µs"
