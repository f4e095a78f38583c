"""Worker processes: forked from one that has loaded what runs need, where the system allows it.

Loading torch and the package takes as long as a short run. On Linux one process loads them once,
beside the one that asks, and forks into the workers before anything is computed, so that no thread
exists that a fork would lose. Elsewhere each worker loads them itself.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing.context import BaseContext

LOADED = ["neuroslam.runs.fleet", "neuroslam.runs.sweep", "numba"]
"""Modules that workers have loaded when they begin."""

START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
"""How worker processes start."""


def worker_context() -> BaseContext:
    """Return the context of :mod:`multiprocessing` that starts workers."""
    context = multiprocessing.get_context(START_METHOD)
    context.set_forkserver_preload(LOADED)
    return context


def prepare_workers(jobs: int | None, elsewhere: str | None = None) -> None:
    """Begin to load what workers need, if there are to be any; return at once.

    Args:
        jobs: Processes at a time; ``None`` or 1: none besides this one.
        elsewhere: Address of a cluster that has the workers instead.
    """
    if (jobs or 1) > 1 and not elsewhere and START_METHOD == "forkserver":
        from multiprocessing import forkserver

        with interrupts_deferred():
            worker_context()
            forkserver.ensure_running()


def start_worker(environment: dict[str, str]) -> None:
    """Take over the environment and the interrupts of a process that was asked for."""
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Defer Ctrl-C to the end of the block; processes started in it never receive it."""
    if os.name != "posix":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
