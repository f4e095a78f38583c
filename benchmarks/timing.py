"""How everything here is timed: CPU time of one thread, median of several rounds."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Row(NamedTuple):
    step: str
    size: str
    reference: str
    target: str
    measured: str


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
