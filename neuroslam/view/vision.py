"""The only door to torchvision: names ``make_grid``, ``transforms`` (its v2), function ``load``.

Nothing is imported before the first use, as torchvision takes seconds. Beside a CPU-only torch the
compiled operators of a torchvision built for a GPU do not load, and its import fails with "operator
torchvision::nms does not exist"; it asks for the mere schemas of two operators that we never call.
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
    """Import torchvision, whatever build it is, and return it.

    Example:
        >>> load().__name__
        'torchvision'
    """
    if "torchvision" in sys.modules:
        return sys.modules["torchvision"]
    _forget_failed_import()  # a bare import that failed before leaves parts that break the next
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
    for name in [name for name in sys.modules if name.startswith("torchvision.")]:
        del sys.modules[name]


def __getattr__(name: str) -> object:
    """Import torchvision when one of its names is asked for, and keep the name (PEP 562)."""
    if name not in ("make_grid", "transforms"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    load()
    if name == "make_grid":
        value = importlib.import_module("torchvision.utils").make_grid
    else:
        value = importlib.import_module("torchvision.transforms.v2")
    globals()[name] = value
    return value
