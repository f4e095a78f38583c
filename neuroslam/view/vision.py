"""Loads torchvision on first use: ``make_grid``, ``transforms`` (its v2) and ``load()``.

The import takes seconds, so it is delayed to the first use. With a CPU-only torch, the compiled
operators of a torchvision built for a GPU do not load, and its import fails with "operator
torchvision::nms does not exist". It only needs the schemas of two operators, which neuroslam never
calls, so :func:`load` defines them.
"""

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torchvision.transforms import v2 as transforms
    from torchvision.utils import make_grid

__all__ = ["load", "make_grid", "transforms"]

_SCHEMA = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"


def load() -> ModuleType:
    """Import torchvision of any build, and return it.

    Example:
        >>> load().__name__
        'torchvision'
    """
    if "torchvision" in sys.modules:
        return sys.modules["torchvision"]
    _forget_failed_import()  # its remains would break the next import
    try:
        return importlib.import_module("torchvision")
    except RuntimeError as error:
        if "operator torchvision::nms does not exist" not in str(error):
            raise
    for name in ("nms", "qnms"):
        if not hasattr(torch.ops.torchvision, name):
            torch.library.define(f"torchvision::{name}", _SCHEMA)
    _forget_failed_import()
    return importlib.import_module("torchvision")


def _forget_failed_import() -> None:
    """Remove the submodules that a failed import has left."""
    for name in [name for name in sys.modules if name.startswith("torchvision.")]:
        del sys.modules[name]


def __getattr__(name: str) -> object:
    """Import torchvision on the first access to one of its names, and store the name (PEP 562)."""
    if name not in ("make_grid", "transforms"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    load()
    if name == "make_grid":
        value = importlib.import_module("torchvision.utils").make_grid
    else:
        value = importlib.import_module("torchvision.transforms.v2")
    globals()[name] = value
    return value
