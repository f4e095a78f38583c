"""Independent calls in parallel: in processes of this machine, or on a Ray cluster.

Each call runs with one thread of torch and OpenCV, so results are equal wherever it runs.
"""

import contextlib
import os
import pickle
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, TypeVar

from neuroslam.config.populations import PLUGINS, known_kinds
from neuroslam.errors import NeuroslamError, RunError
from neuroslam.interrupts import end_runs
from neuroslam.limits import MAX_MEMORY
from neuroslam.threads import limit_threads
from neuroslam.workers import interrupts_deferred, start_worker, worker_context

_RAY_CLUSTER = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Environment variable that, as ``0``, lets a Ray that is started here listen on the loopback
address only, on any system; Ray reads it when it is imported."""

T = TypeVar("T")
R = TypeVar("R")


def parallel_map(
    function: Callable[[T], R], items: Sequence[T], jobs: int | None = None, ray: str | None = None
) -> list[R]:
    """Return ``[function(item) for item in items]``, computed in parallel.

    Args:
        function: Function of a module, which another process can import; depends on its item only.
        items: Its arguments.
        jobs: Calls at a time; default: 1, with Ray the number of processors.
        ray: Address of a Ray cluster, or ``local`` to start one here; ``None``: processes.

    Raises:
        RunError: If ``jobs`` is below 1, Ray is missing or cannot be reached, or a process died.
        Exception: The first that the function raises; the remaining calls are cancelled.

    Example:
        >>> parallel_map(abs, [-1, 2, -3])
        [1, 2, 3]
    """
    found: dict[int, R] = {}
    with contextlib.closing(outcomes(function, items, jobs, ray)) as each:
        for number, outcome in each:
            if isinstance(outcome, NeuroslamError):
                raise outcome
            found[number] = outcome
    return [found[number] for number in range(len(items))]


def outcomes(
    function: Callable[[T], R], items: Sequence[T], jobs: int | None = None, ray: str | None = None
) -> Generator[tuple[int, R | NeuroslamError], None, None]:
    """Yield the number and the outcome of each item as it ends; close to cancel the rest.

    Args:
        function: As for :func:`parallel_map`.
        items: As for :func:`parallel_map`.
        jobs: As for :func:`parallel_map`.
        ray: As for :func:`parallel_map`.

    Yields:
        The result, or the :class:`~neuroslam.errors.NeuroslamError` that the function raised, or a
        :class:`RunError` if its process died; the other items continue.

    Raises:
        RunError: If ``jobs`` is below 1, Ray is missing or cannot be reached.

    Example:
        >>> list(outcomes(len, ["a", "bc"]))
        [(0, 1), (1, 2)]
    """
    if jobs is not None and jobs < 1:
        raise RunError(f"jobs is {jobs}; expected 1 or more")
    numbered = dict(enumerate(items))
    if not numbered:
        return
    if ray is not None:
        yield from _on_ray(function, numbered, jobs, ray)
    elif jobs is None or jobs == 1:
        for number, item in numbered.items():
            yield number, _attempt(function, item)
    else:
        yield from _in_processes(function, numbered, jobs)


_SAVING_S = 60.0
"""Longest time that a run has to save itself after its parent process has ended."""

_idle = threading.Event()
_idle.set()


def _attempt(function: Callable[[T], R], item: T) -> R | NeuroslamError:
    _idle.clear()
    try:
        with limit_threads():
            return function(item)
    except NeuroslamError as error:
        return error
    finally:
        _idle.set()


# --- processes of this machine ------------------------------------------------------------------


def _in_processes(
    function: Callable[[T], R], numbered: Mapping[int, T], jobs: int
) -> Iterator[tuple[int, R | NeuroslamError]]:
    lost: list[int] = []
    with _workers(min(jobs, len(numbered))) as pool:
        futures: dict[Future[R | NeuroslamError], int] = {}
        with interrupts_deferred():
            for number, item in numbered.items():
                try:
                    futures[pool.submit(_attempt, function, item)] = number
                except BrokenProcessPool:
                    lost.append(number)
        for future in as_completed(futures):
            try:
                outcome = future.result()
            except BrokenProcessPool:
                lost.append(futures[future])
            else:
                yield futures[future], outcome
    for number in sorted(lost):  # one death ends the pool: retry each item alone
        if len(numbered) == 1:
            yield number, _died()
        else:
            yield from _in_processes(function, {number: numbered[number]}, 1)


@contextlib.contextmanager
def _workers(n: int) -> Iterator[ProcessPoolExecutor]:
    """Keep a pool of processes that end when this block is left early, or this process ends."""
    context = worker_context()
    child_end, parent_end = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(n, context, _start_worker, (child_end, dict(os.environ)))
    try:
        yield pool
        pool.shutdown()
    finally:
        parent_end.close()
        pool.shutdown(cancel_futures=True)
        child_end.close()


def _start_worker(lifeline: Connection, environment: dict[str, str]) -> None:
    """Leave Ctrl-C to the parent; when it closes its end of the pipe, save the run and end."""

    def end_with_parent() -> None:
        with contextlib.suppress(EOFError, OSError):
            lifeline.recv()
        if end_runs():
            _idle.wait(_SAVING_S)
        os._exit(1)

    start_worker(environment)
    threading.Thread(target=end_with_parent, daemon=True).start()


def _died() -> RunError:
    return RunError(
        "its process died: out of memory, killed, or started by a script without "
        "`if __name__ == '__main__':`"
    )


# --- a Ray cluster ------------------------------------------------------------------------------


def _on_ray(
    function: Callable[[T], R], numbered: Mapping[int, T], jobs: int | None, address: str
) -> Iterator[tuple[int, R | NeuroslamError]]:
    if address == "local":
        os.environ.setdefault(_RAY_CLUSTER, "0")  # no other machine reaches it
    try:
        import ray
        from ray.exceptions import OutOfMemoryError, WorkerCrashedError
    except ImportError as error:
        raise RunError(
            f"Ray cannot be imported ({error}); pip install neuroslam[sweep], or omit --ray"
        ) from None
    started_here = not ray.is_initialized()
    if started_here:
        _connect(ray, address, jobs)
    running: dict[Any, int] = {}
    try:
        task: Any = ray.remote(num_cpus=1, max_retries=0)(_attempt_on_ray)
        settings = {name: os.environ.get(name, "") for name in (PLUGINS, MAX_MEMORY)}
        waiting = deque(numbered.items())
        while waiting or running:
            while waiting and (jobs is None or len(running) < jobs):
                number, item = waiting.popleft()
                running[task.remote(settings, pickle.dumps((function, item)))] = number
            (done,), _ = ray.wait(list(running), num_returns=1)
            number = running.pop(done)
            try:
                outcome = ray.get(done)
            except (WorkerCrashedError, OutOfMemoryError):
                outcome = _died()
            yield number, outcome
    finally:
        for unfinished in running:
            ray.cancel(unfinished, force=True)
        if started_here:
            ray.shutdown()


def _attempt_on_ray(settings: dict[str, str], call: bytes) -> object:
    """Attempt a call in a worker, which gets no environment of this process.

    Args:
        settings: Environment variables with the plugins and the budget of memory.
        call: Function and item, pickled: an item can hold a config, whose populations have to be
            known when it is unpickled.
    """
    os.environ |= settings
    try:
        known_kinds()  # loads the plugins: the item can hold a class of one
        function, item = pickle.loads(call)
    except NeuroslamError as error:  # a plugin is not on this machine
        return error
    return _attempt(function, item)


def _connect(ray: ModuleType, address: str, jobs: int | None) -> None:
    quiet = {"log_to_driver": False, "logging_level": "error"}
    try:
        if address == "local":
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage reports
            ray.init("local", num_cpus=jobs, include_dashboard=False, **quiet)
        else:
            ray.init(address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        line = " ".join(str(error).split())
        raise RunError(
            f"--ray {address}: cannot be reached ({line}); expected local, auto or HOST:PORT"
        ) from None
