"""How torch computes in a brain: CPU threads, and the types of its tensors.

One thread of torch and of OpenCV is fastest for the small arrays of a brain.

OpenMP, by which torch computes in parallel, does not survive ``fork``: a child that starts a
parallel region of its parent's library hangs. Importing this module lets torch compute by one
thread in every forked child, as torch's own ``DataLoader`` does.
"""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

import cv2
import torch

P = ParamSpec("P")
R = TypeVar("R")

_PROCESSORS = os.cpu_count() or 1


class limit_threads:  # noqa: N801 - used like a function
    """Limit torch and OpenCV to ``n`` threads within a ``with`` statement.

    Args:
        n: Number of threads.

    Example:
        >>> with limit_threads(1):
        ...     torch.get_num_threads(), cv2.getNumThreads()
        (1, 1)
    """

    def __init__(self, n: int = 1) -> None:
        self.n = n
        self.before = torch.get_num_threads(), cv2.getNumThreads()

    def __enter__(self) -> None:
        self._set(self.n, self.n)

    def __exit__(self, *_exception: object) -> None:
        self._set(*self.before)

    @staticmethod
    def _set(torch_threads: int, cv_threads: int) -> None:
        if torch.get_num_threads() != torch_threads:
            torch.set_num_threads(torch_threads)
        if cv2.getNumThreads() != cv_threads:
            cv2.setNumThreads(cv_threads)


def usable_threads(n: int) -> int:
    """Return the threads that a config asks for, at most as many as there are processors.

    Example:
        >>> usable_threads(1)
        1
    """
    return min(n, _PROCESSORS)


def without_autocast() -> AbstractContextManager[object]:
    """Let torch compute in the types of its tensors, also where a caller uses ``torch.autocast``.

    Example:
        >>> one = torch.ones(1, 1)
        >>> with torch.autocast("cpu", dtype=torch.bfloat16), without_autocast():
        ...     (one @ one).dtype
        torch.float32
    """
    disabled = ExitStack()
    for kind in ("cpu", "cuda"):
        if torch.is_autocast_enabled(kind):
            disabled.enter_context(torch.autocast(kind, enabled=False))
    return disabled


def in_own_types(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function compute in the types of its tensors, also under ``torch.autocast``.

    Positions and phases have too few digits in the types of autocast.

    Example:
        >>> product = in_own_types(torch.matmul)
        >>> with torch.autocast("cpu", dtype=torch.bfloat16):
        ...     product(torch.ones(1, 1), torch.ones(1, 1)).dtype
        torch.float32
    """

    @wraps(function)
    def computed(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.is_autocast_enabled() or torch.is_autocast_enabled("cpu"):
            with without_autocast():
                return function(*args, **kwargs)
        return function(*args, **kwargs)

    return computed


def is_plain(n: int) -> bool:
    """Return whether torch and OpenCV use ``n`` threads already, and torch no autocast.

    It costs less than a microsecond; entering the two contexts costs several.
    """
    return (
        torch.get_num_threads() == n == cv2.getNumThreads()
        and not torch.is_autocast_enabled()  # of CUDA
        and not torch.is_autocast_enabled("cpu")
    )


def _in_child() -> None:
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_in_child)
