"""Modules as pickles carry them: tensors as arrays, which each process gets for itself.

Checkpoints hold no pickles. These functions are for objects on their way to another process or a
copy: ``pickle``, ``copy.deepcopy``, ``torch.save``, joblib, Ray, and started processes. Between
processes torch would pass tensors as shared memory: a table that one process writes to would
change in the other, and arrays that view a tensor would view memory that is freed.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn


class Calls:
    """Hook of a module that calls one of its methods; a lambda could not be pickled.

    Example:
        >>> module = nn.Module()
        >>> handle = module.register_load_state_dict_post_hook(Calls("eval"))
        >>> module.load_state_dict({}), module.training
        (<All keys matched successfully>, False)
    """

    def __init__(self, method: str) -> None:
        self.method = method

    def __call__(self, module: nn.Module, *_unused: object) -> None:
        """Call the method without arguments."""
        getattr(module, self.method)()


class PackedTensor(NamedTuple):
    """A tensor as an array, with what an array does not have."""

    array: np.ndarray
    device: str
    requires_grad: bool
    is_parameter: bool


def packed(attributes: dict[str, Any]) -> dict[str, Any]:
    """Replace the tensors among the attributes of a module by arrays.

    Args:
        attributes: ``__dict__`` of a module; it is not altered. Its parts are left to themselves.

    Returns:
        A dict from which :func:`unpacked` makes the attributes of a copy.
    """
    inner = {
        name: {key: _pack(value) for key, value in attributes[name].items()}
        for name in ("_buffers", "_parameters")
        if name in attributes
    }
    return {name: _pack(value) for name, value in attributes.items()} | inner


def unpacked(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes with tensors, in memory of their own, in place of arrays."""
    inner = {
        name: {key: _unpack(value) for key, value in attributes[name].items()}
        for name in ("_buffers", "_parameters")
        if name in attributes
    }
    return {name: _unpack(value) for name, value in attributes.items()} | inner


def as_arrays(state: dict[str, Tensor]) -> dict[str, np.ndarray]:
    """Return a ``state_dict`` as arrays on the CPU."""
    return {name: tensor.numpy(force=True) for name, tensor in state.items()}


def as_tensors(state: dict[str, np.ndarray]) -> dict[str, Tensor]:
    """Return arrays as tensors with memory of their own: the arrays may be read-only."""
    return {name: torch.tensor(array) for name, array in state.items()}


def _pack(value: Any) -> Any:  # noqa: ANN401
    if type(value) in (list, tuple) and any(isinstance(item, Tensor) for item in value):
        return type(value)(_pack(item) for item in value)
    if type(value) is dict and any(isinstance(item, Tensor) for item in value.values()):
        return {key: _pack(item) for key, item in value.items()}
    if not isinstance(value, Tensor) or type(value) not in (Tensor, nn.Parameter):
        return value
    try:
        array = value.numpy(force=True)
    except (TypeError, RuntimeError):  # such as bfloat16, or a sparse tensor
        return value
    is_parameter = isinstance(value, nn.Parameter)
    return PackedTensor(array, str(value.device), value.requires_grad, is_parameter)


def _unpack(value: Any) -> Any:  # noqa: ANN401
    if type(value) in (list, tuple) and any(isinstance(item, PackedTensor) for item in value):
        return type(value)(_unpack(item) for item in value)
    if type(value) is dict and any(isinstance(item, PackedTensor) for item in value.values()):
        return {key: _unpack(item) for key, item in value.items()}
    if not isinstance(value, PackedTensor):
        return value
    tensor = torch.tensor(value.array, device=value.device)
    if value.is_parameter:
        return nn.Parameter(tensor, value.requires_grad)
    return tensor.requires_grad_() if value.requires_grad else tensor
