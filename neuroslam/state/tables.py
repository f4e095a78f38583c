"""State that grows or changes every frame: tables of rows, and named numbers."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.state.pickling import packed, unpacked


class GrowingTable(nn.Module):
    """Columns of equal length that grow by a row: capacity doubles, ``n`` counts the rows in use.

    Each column is a buffer, so ``.to`` moves it. ``state_dict`` holds the used part only, and
    loading takes over whatever length was saved.

    Args:
        columns: For each column the shape of one entry (``()`` for a number) and its dtype.

    Example:
        >>> table = GrowingTable({"x_m": ((), torch.float64)})
        >>> table.append(x_m=0.5), table.append(x_m=1.5)
        (0, 1)
        >>> table["x_m"].tolist()
        [0.5, 1.5]
    """

    columns: tuple[str, ...]
    n: int
    optional: ClassVar[bool] = False
    """Whether an empty table has no part in a state, so that states without it can be loaded."""

    def __init__(self, columns: Mapping[str, tuple[tuple[int, ...], torch.dtype]]) -> None:
        super().__init__()
        self.n = 0
        self.columns = tuple(columns)
        self._arrays: dict[str, tuple[Tensor, np.ndarray]] = {}
        for name, (shape, dtype) in columns.items():
            self.register_buffer(name, torch.empty((0, *shape), dtype=dtype))
        self.register_load_state_dict_pre_hook(_resize_to_saved)
        self.register_state_dict_post_hook(_keep_used_part)

    def append(self, **row: float | Tensor) -> int:
        """Add one row, a value for every column, and return its number."""
        self._make_room()
        for name in self.columns:
            column, value = self._column(name), row[name]
            if column.device.type == "cpu":
                self._whole(name)[self.n] = value
            else:
                column[self.n] = value
        self.n += 1
        return self.n - 1

    def append_empty(self) -> int:
        """Add one row for the caller to write, into :meth:`storage`, and return its number."""
        self._make_room()
        self.n += 1
        return self.n - 1

    def storage(self) -> dict[str, Tensor]:
        """Return every column with its spare rows.

        Example:
            >>> table = GrowingTable({"x_m": ((), torch.float64)})
            >>> row = table.append_empty()
            >>> table.storage()["x_m"][row] = 0.5
            >>> table["x_m"].tolist()
            [0.5]
        """
        return cast(dict[str, Tensor], dict(self._buffers))

    def _make_room(self) -> None:
        if self.n == self._column(self.columns[0]).shape[0]:
            self.reserve(max(16, 2 * self.n))

    def reserve(self, capacity: int) -> None:
        """Make room for ``capacity`` rows; the rows in use stay."""
        for name in self.columns:
            old = self._column(name)
            new = old.new_zeros((capacity, *old.shape[1:]))
            new[: self.n] = old[: self.n]
            self._buffers[name] = new

    def replace(self, **columns: Tensor) -> None:
        """Put whole new columns in place of the old ones, all of them, all of one length."""
        if set(columns) != set(self.columns):
            raise ValueError(
                f"GrowingTable: got columns {sorted(columns)}, has {sorted(self.columns)}"
            )
        lengths = {len(value) for value in columns.values()}
        if len(lengths) != 1:
            raise ValueError(f"GrowingTable: columns of different lengths {sorted(lengths)}")
        for name, value in columns.items():
            old = self._column(name)
            self._buffers[name] = value.to(old).reshape((-1, *old.shape[1:])).clone()
        self.n = lengths.pop()

    def __getitem__(self, name: str) -> Tensor:
        """Return the used part of a column, a view: writing to it changes the table."""
        return self._column(name)[: self.n]

    def array(self, name: str) -> np.ndarray:
        """Return the used part of a column on the CPU as numpy's view, a few times faster."""
        return self._whole(name)[: self.n]

    def _whole(self, name: str) -> np.ndarray:
        column = self._column(name)
        tensor, whole = self._arrays.get(name, (None, None))
        if whole is None or tensor is not column:
            self._arrays[name] = column, whole = column, column.numpy()
        return whole

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the columns as ``.to`` does; they keep their types, as rows are of 64 bits."""

        def moved(column: Tensor) -> Tensor:
            to = fn(column)
            return to if to.dtype == column.dtype else column.to(to.device)

        self._arrays = {}
        return super()._apply(moved, recurse)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy keeps: numpy's views are of this table's columns alone."""
        return packed(self.__dict__ | {"_arrays": {}})

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over the columns of another table, in memory of its own."""
        super().__setstate__(unpacked(state))

    def __len__(self) -> int:
        """Return the number of rows in use."""
        return self.n

    def __bool__(self) -> bool:
        """Return True, for an empty table is a table too."""
        return True

    def _column(self, name: str) -> Tensor:
        """Return a column with its spare rows; torch allows ``None``, a table does not."""
        return cast(Tensor, self._buffers[name])


def _resize_to_saved(
    module: GrowingTable, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    if module.optional and not any(prefix + name in state for name in module.columns):
        module.n = 0
        for name in module.columns:
            old = module._column(name)
            module._buffers[name] = state[prefix + name] = old.new_empty((0, *old.shape[1:]))
    for name in module.columns:
        saved = state.get(prefix + name)
        if saved is not None:
            old = module._column(name)
            if saved.shape[1:] == old.shape[1:]:  # another entry shape is left for torch to refuse
                module._buffers[name] = old.new_empty(saved.shape)
                module.n = saved.shape[0]


def _keep_used_part(
    module: GrowingTable, state: dict[str, Tensor], prefix: str, _metadata: object
) -> None:
    for name in module.columns:
        if module.optional and not module.n:
            del state[prefix + name]
        else:
            state[prefix + name] = state[prefix + name][: module.n]


class Scalars(nn.Module):
    """Named numbers that change every frame: Python numbers in use, 0-d tensors in ``state_dict``.

    A tensor operation on a single number costs microseconds; a Python one does not. A subclass may
    declare the names and their types, for readers and type checkers.

    Raises:
        ValueError: If a name would hide one of ``nn.Module``.

    Example:
        >>> state = Scalars(frame=0, heading_rad=0.5)
        >>> state.frame += 1
        >>> {name: value.item() for name, value in state.state_dict().items()}
        {'frame': 1, 'heading_rad': 0.5}
    """

    kinds: dict[str, type[float]]

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:  # noqa: ANN401
            """Have numbers that no subclass declares: to a type checker they would be modules."""
            ...

    def __init__(self, **values: float) -> None:
        super().__init__()
        hidden = [name for name in values if hasattr(self, name)]
        if hidden:
            raise ValueError(f"Scalars: {hidden[0]!r} is a name of nn.Module; take another")
        self.kinds = {name: type(value) for name, value in values.items()}
        for name, value in values.items():
            setattr(self, name, value)
        self.register_state_dict_post_hook(_write_scalars)
        self.register_load_state_dict_pre_hook(_read_scalars)

    def __setattr__(self, name: str, value: Any) -> None:  # noqa: ANN401
        """Set a number the short way: nn.Module takes microseconds to see that it is no tensor."""
        if name in self.__dict__.get("kinds", ()):
            self.__dict__[name] = value
        else:
            super().__setattr__(name, value)


def _write_scalars(
    module: Scalars, state: dict[str, Tensor], prefix: str, _metadata: object
) -> None:
    for name, kind in module.kinds.items():
        dtype = torch.int64 if kind is int else torch.float64
        state[prefix + name] = torch.tensor(getattr(module, name), dtype=dtype)


def _read_scalars(
    module: Scalars,
    state: dict[str, Tensor],
    prefix: str,
    _metadata: object,
    _strict: bool,
    missing_keys: list[str],
    *_unused: object,
) -> None:
    for name, kind in module.kinds.items():
        saved = state.pop(prefix + name, None)
        if saved is None:
            missing_keys.append(prefix + name)
        else:
            setattr(module, name, kind(saved.item()))
