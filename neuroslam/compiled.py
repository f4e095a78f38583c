"""Compiled steps: plain loops that numba compiles when they are first called.

A compiled step stands in the file of the step that defines it, in torch or numpy, and gives the
same result up to rounding. It takes numpy arrays that share memory with the buffers, and is used
where one brain runs on the CPU without gradients. ``NEUROSLAM_COMPILED=0`` in the environment turns
all of them off. What was compiled is kept beside the file or in the user's cache folder, and
compiled again in each process where neither can be written.
"""

import gc
import os
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

P = ParamSpec("P")
R = TypeVar("R")

ENABLED = os.environ.get("NEUROSLAM_COMPILED", "1") != "0"
"""Whether modules take compiled steps where they can."""

STEPS: dict[str, "Compiled[Any, Any]"] = {}
"""Every compiled step of the files imported so far, by ``module.name``."""


announce: Callable[[], object] | None = None
"""Called once in a process, before the first step that is not kept on disk is compiled."""


class Compiled(Generic[P, R]):
    """A function of numbers and numpy arrays that is compiled when it is first called.

    It may call numpy, :mod:`math`, and compiled functions of its own file.

    Attributes:
        plain: The same function, run by Python: for tests.
    """

    def __init__(self, plain: Callable[P, R]) -> None:
        self.plain = plain
        self.__doc__, self.__name__ = plain.__doc__, plain.__name__
        self.__module__, self.__wrapped__ = plain.__module__, plain
        self._dispatcher: Callable[P, R] | None = None
        STEPS[f"{plain.__module__}.{plain.__name__}"] = self

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the compiled function."""
        if self._dispatcher is not None:
            return self._dispatcher(*args, **kwargs)
        with _no_search_for_cycles():  # compilation makes many objects: a sixth of its time
            return self.dispatcher()(*args, **kwargs)

    def dispatcher(self) -> Callable[P, R]:
        """Return numba's function, for callers that call it very often."""
        if self._dispatcher is None:
            import numba  # a quarter of a second: only where a step runs

            self._dispatcher = _kept(numba.njit, self._linked())
            _announce_unless_kept(self._dispatcher)
        return self._dispatcher

    def _linked(self) -> Callable[P, R]:
        """Return the function with the compiled functions that it calls in place of wrappers."""
        plain = self.plain
        assert isinstance(plain, types.FunctionType)
        within = dict(plain.__globals__)
        for name in _names(plain.__code__):
            other = within.get(name)
            if isinstance(other, Compiled):
                within[name] = other.dispatcher()
        linked = types.FunctionType(
            plain.__code__, within, plain.__name__, plain.__defaults__, plain.__closure__
        )
        linked.__module__, linked.__qualname__ = plain.__module__, plain.__qualname__
        linked.__kwdefaults__ = plain.__kwdefaults__
        return linked


@contextmanager
def _no_search_for_cycles() -> Iterator[None]:
    searches = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searches:
            gc.enable()


def _names(code: types.CodeType) -> set[str]:
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def _kept(njit: Callable[..., Any], function: Callable[P, R]) -> Callable[P, R]:
    # No step is handed over as a C function: its wrapper takes a twentieth of the compilation.
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # no folder can be written
        return njit(**options)(function)


def _announce_unless_kept(dispatcher: object) -> None:
    """Call :data:`announce` if numba has not kept this step; not knowing that, do nothing."""
    global announce
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    path = getattr(index, "_index_path", None)
    if announce is not None and path is not None and not os.path.exists(path):
        tell, announce = announce, None
        tell()


def compiled(plain: Callable[P, R]) -> Compiled[P, R]:
    """Mark a function as a compiled step.

    Example:
        >>> @compiled
        ... def total(values):
        ...     sum_ = 0.0
        ...     for value in values:
        ...         sum_ += value
        ...     return sum_
        >>> total.plain([1.0, 2.0])
        3.0
    """
    return Compiled(plain)


def runs_compiled(*tensors: "Tensor") -> bool:
    """Return whether a compiled step may take these tensors: on the CPU, without gradients.

    Example:
        >>> import torch
        >>> runs_compiled(torch.zeros(2, requires_grad=True))
        False
    """
    if not ENABLED:
        return False
    for tensor in tensors:  # noqa: SIM110 - a generator takes longer
        if tensor.requires_grad or not tensor.is_cpu:
            return False
    return True


def plain_array(array: "np.ndarray") -> "np.ndarray":
    """Return an array that is contiguous and may be written, itself where it is: one type of it.

    Example:
        >>> import numpy as np
        >>> plain_array(np.zeros((4, 6))[:, ::2]).flags.c_contiguous
        True
    """
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else array.copy()
