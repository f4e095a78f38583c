"""Requests to end early: Ctrl-C, SIGTERM, SIGHUP, or the end of the parent process."""

import contextlib
import signal
import threading
from collections.abc import Iterator

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
"""Signals that end a command; a run is saved first."""

_running: list[list[int]] = []  # of each run in progress, the interrupts that it has noted


@contextlib.contextmanager
def noting_interrupts() -> Iterator[list[int]]:
    """Let a signal end the run after the current frame, so that brain and files agree.

    A second Ctrl-C interrupts at once. Only the main thread receives signals; where one is ignored,
    as by nohup or in a process that leaves it to its parent, it stays so.
    """
    interrupts: list[int] = []

    def note(number: int, _frame: object) -> None:
        interrupts.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    _running.append(interrupts)
    with handling(note):
        try:
            yield interrupts
        finally:
            _running.remove(interrupts)


@contextlib.contextmanager
def raising_interrupts() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise ``KeyboardInterrupt``, as Ctrl-C does."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    with handling(interrupt, SIGNALS[1:]):
        yield


@contextlib.contextmanager
def handling(handler: object, signals: tuple[signal.Signals, ...] = SIGNALS) -> Iterator[None]:
    """Handle signals that are not ignored, in the main thread; in others, change nothing."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in signals:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handler)  # type: ignore[arg-type]
    try:
        yield
    finally:
        for number, was in before.items():
            signal.signal(number, was)


def end_runs() -> bool:
    """Let the runs in progress end after their current frames, as a signal would; any thread may.

    Returns:
        Whether there are any.

    Example:
        >>> with noting_interrupts() as interrupts:
        ...     end_runs(), bool(interrupts)
        (True, True)
    """
    for interrupts in list(_running):
        interrupts.append(0)
    return bool(_running)
