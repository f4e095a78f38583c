"""Modules whose state is saved and merged, and rules by which two states become one."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from itertools import chain
from operator import is_
from typing import TYPE_CHECKING, Any, ClassVar, Generic, ParamSpec, Self, TypeVar, cast, overload

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.errors import MapError
from neuroslam.state.join import Join
from neuroslam.state.pickling import packed, unpacked
from neuroslam.state.renumbering import Renumbering, summed_rows
from neuroslam.threads import without_autocast

P = ParamSpec("P")
T = TypeVar("T")
M = TypeVar("M", bound=nn.Module)

State = dict[str, Tensor]
"""A ``state_dict``, or the part of one that belongs to a module, without its prefix."""

Arrays = tuple[np.ndarray, ...]
"""Arrays that share the memory of a module's tensors."""

Rule = Callable[[Tensor, Tensor, Join], Tensor]
"""Merge of a loaded and a partial tensor of one name."""


class QuickModule(nn.Module):
    """A module whose parts are found as fast as other attributes, after the first time.

    Torch finds a part after two failed searches, for a microsecond, and a frame has fifty of them.
    Setting another part removes the one that was found.
    """

    if not TYPE_CHECKING:  # as torch declares it

        def __getattr__(self, name: str) -> Tensor | nn.Module:
            found = super().__getattr__(name)
            if isinstance(found, nn.Module):
                self.__dict__[name] = found
            return found

    def __setattr__(self, name: str, value: Any) -> None:  # noqa: ANN401
        """Set an attribute as torch does; a part that is set to ``None`` is not found any more."""
        if value is None and name in self.__dict__.get("_modules", ()):
            self.__dict__.pop(name, None)
        super().__setattr__(name, value)  # pyright: ignore[reportArgumentType]

    def __delattr__(self, name: str) -> None:
        """Delete an attribute, and what was found by its name."""
        if name in self._modules:
            self.__dict__.pop(name, None)
        super().__delattr__(name)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or convert all tensors, as ``.to`` does; refuse types of too few digits.

        Raises:
            TypeError: If the type would be of 16 bits or less.
        """
        dtype = fn(torch.empty(0)).dtype
        if dtype.is_floating_point and dtype.itemsize < 4:
            raise TypeError(
                f"{type(self).__name__}: {dtype} has too few digits for its activity and "
                "positions; expected torch.float32 or torch.float64, or a device alone"
            )
        self.__dict__.pop("_arrays", None)  # parameters are moved in place
        return super()._apply(fn, recurse)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle keeps: tensors as arrays, and each part once.

        Arrays that view the tensors are left out, for they would not share the copy's memory.
        """
        left_out = {*self.__dict__["_modules"], "_arrays"}
        return packed({name: v for name, v in self.__dict__.items() if name not in left_out})

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over the attributes of another module of the class."""
        super().__setstate__(unpacked(state))


class BufferModule(QuickModule):
    """A module whose state is in buffers that are replaced in every step.

    Attributes:
        growing: Names of buffers that take the shape that was saved when a state is loaded.
    """

    growing: ClassVar[tuple[str, ...]] = ()

    def __init__(self) -> None:
        super().__init__()
        self.register_load_state_dict_pre_hook(_make_room)

    def __setattr__(self, name: str, value: Any) -> None:  # noqa: ANN401
        """Replace a buffer at once: torch checks it anew each time, which costs more than a step.

        Anything else is left to torch.
        """
        buffers = self.__dict__.get("_buffers")
        if buffers is not None and type(value) is Tensor and name in buffers:
            buffers[name] = value
        else:
            super().__setattr__(name, value)

    def arrays(self) -> Arrays | None:
        """Return parameters, then buffers, as numpy arrays that share their memory.

        The arrays of a step are kept for the next one, until a tensor is replaced.

        Returns:
            Contiguous arrays; ``None`` if a tensor is missing or on an accelerator.
        """
        tensors = chain(self._parameters.values(), self._buffers.values())
        kept = self.__dict__.get("_arrays")
        if kept is not None and all(map(is_, tensors, kept[0])):
            return kept[1]
        for name, tensor in self._buffers.items():
            if tensor is not None and not tensor.is_contiguous():
                self._buffers[name] = tensor.contiguous()
        own = [*self._parameters.values(), *self._buffers.values()]
        if any(t is None or t.device.type != "cpu" or not t.is_contiguous() for t in own):
            return None
        arrays = tuple(cast(Tensor, tensor).detach().numpy() for tensor in own)
        self.__dict__["_arrays"] = own, arrays
        return arrays


class ModulesOf(nn.ModuleList, Generic[M]):
    """A list of modules of one class, for readers and type checkers."""

    if TYPE_CHECKING:

        def __iter__(self) -> Iterator[M]: ...

        @overload  # type: ignore[override]  # torch returns modules of any class
        def __getitem__(self, idx: int) -> M: ...

        @overload
        def __getitem__(self, idx: slice) -> "ModulesOf[M]": ...

        def __getitem__(self, idx: int | slice) -> "M | ModulesOf[M]": ...


class Mergeable(BufferModule, ABC):
    """A part of the brain that says how two of its states become one.

    A brain is made of these alone, so that no state can be forgotten when two brains merge.
    """

    @abstractmethod
    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Merge two states into one; neither is altered.

        Args:
            loaded: State of the map that is merged into.
            partial: State of the session that goes on.
            join: How the partial one's ids and coordinates change.

        Returns:
            A state with the same names.
        """

    def renumber(self, change: Renumbering) -> None:
        """Follow a map that forgets experiences and templates.

        Raises:
            MapError: If the part cannot.
        """
        raise MapError(
            f"{type(self).__name__} cannot follow a map that forgets: define renumber(), or set "
            "map.max_experiences and map.consolidate_passes to 0"
        )


class AboutNow(Mergeable):
    """A part whose state is about the present alone: the session that goes on keeps its own."""

    def renumber(self, change: Renumbering) -> None:
        """Do nothing."""

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Return the partial one's state."""
        return dict(partial)


def _make_room(module: BufferModule, state: State, prefix: str, *_unused: object) -> None:
    """Give growing buffers the saved shape, and replace what was made in inference mode.

    Torch copies a state into tensors that are there, and refuses both.
    """
    for name, buffer in module._buffers.items():
        saved = state.get(prefix + name)
        if buffer is None:
            continue
        if name in module.growing and saved is not None:
            module._buffers[name] = buffer.new_empty(saved.shape)
        elif buffer.is_inference():
            module._buffers[name] = buffer.clone()
    for name, parameter in module._parameters.items():
        if parameter is not None and parameter.is_inference():
            module._parameters[name] = nn.Parameter(parameter.clone())


def without_gradients(step: Callable[P, T]) -> Callable[P, T]:
    """Let a step run in inference mode and without autocast; in a brain it loses no time by it."""

    @wraps(step)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        if torch.is_inference_mode_enabled():
            return step(*args, **kwargs)
        with torch.inference_mode(), without_autocast():
            return step(*args, **kwargs)

    return run


# --- rules ---------------------------------------------------------------------------------------


def about_now(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Keep the value of the session that goes on: it is about the present, not learnt."""
    return partial


def summed(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Add sums and counts of one shape.

    Example:
        >>> summed(torch.tensor([1, 2]), torch.tensor([3, 4]), Join.nothing()).tolist()
        [4, 6]
    """
    return loaded + partial


def summed_by_view(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Add sums and counts that have a row for each view; rows of equal views become one.

    Example:
        >>> join = Join.nothing()._replace(views=np.array([1, 2]), n_views=2)
        >>> summed_by_view(torch.tensor([5, 5]), torch.tensor([1, 3]), join).tolist()
        [5, 6, 3]
    """
    return _summed_rows(loaded, partial, join.views)


def summed_by_experience(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Add sums and counts that have a row for each experience; rows of equal ones become one."""
    return _summed_rows(loaded, partial, join.experiences)


def _summed_rows(loaded: Tensor, partial: Tensor, ids: np.ndarray) -> Tensor:
    to = torch.from_numpy(ids[: len(partial)])
    n = max(len(loaded), int(to.max()) + 1 if len(to) else 0)
    grown = loaded.new_zeros((n, *loaded.shape[1:]))
    grown[: len(loaded)] = loaded
    return grown.index_add(0, to, partial.to(grown)[: len(to)])


def rows_of_views(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Keep the loaded rows, then those of partial views that are new; a row for each view.

    Raises:
        MapError: If a table has more or fewer rows than its session has views.

    Example:
        >>> join = Join.nothing()._replace(views=np.array([0, 2]), n_views=2)
        >>> rows_of_views(torch.tensor([5, 6]), torch.tensor([1, 3]), join).tolist()
        [5, 6, 3]
    """
    return _kept_rows(loaded, partial, join.views, join.n_views, "view")


def rows_of_experiences(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Keep the loaded rows, then those of partial experiences that are new; one for each."""
    return _kept_rows(loaded, partial, join.experiences, join.n_experiences, "experience")


def _kept_rows(loaded: Tensor, partial: Tensor, ids: np.ndarray, n: int, what: str) -> Tensor:
    for whose, table, expected in (("loaded", loaded, n), ("partial", partial, len(ids))):
        if len(table) != expected:  # rows would go to others than they were learnt of
            raise MapError(
                f"merge: the {whose} table has {len(table)} rows, expected one for each of "
                f"{expected} {what}s"
            )
    return torch.cat([loaded, partial[torch.from_numpy(np.flatnonzero(ids >= n))].to(loaded)])


def renamed(number: Tensor, ids: np.ndarray) -> Tensor:
    """Look a number up in a table of ids; negative ones mean none, and stay.

    Example:
        >>> renamed(torch.tensor(1), np.array([5, 7])).item()
        7
    """
    old = int(number)
    return number if old < 0 else number.new_tensor(int(ids[old]))


def view_id(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Rename the id of a view; -1 stays."""
    return renamed(partial, join.views)


def experience_id(loaded: Tensor, partial: Tensor, join: Join) -> Tensor:
    """Rename the id of an experience; -1 stays."""
    return renamed(partial, join.experiences)


def rule_of(name: str, rules: Mapping[str, Rule]) -> Rule | None:
    """Return the rule of a tensor: of its own name, or of the first part of it.

    Example:
        >>> rule_of("counts.sum", {"counts": summed}) is summed, rule_of("rates", {})
        (True, None)
    """
    return rules.get(name) or rules.get(name.partition(".")[0])


def merge_by_rules(rules: Mapping[str, Rule], loaded: State, partial: State, join: Join) -> State:
    """Merge every tensor by its rule.

    Raises:
        MapError: If one has none: what is learnt is not lost in silence.
    """
    merged: State = {}
    for name, value in partial.items():
        rule = rule_of(name, rules)
        if rule is None:
            raise MapError(f"merge: {name} has no rule; add it to merge_rules")
        merged[name] = rule(loaded[name], value, join)
    return merged


def renumbered_by_rules(rules: Mapping[str, Rule], state: State, change: Renumbering) -> State:
    """Return the tensors of a state that change when the map forgets, by their rules of merging.

    Raises:
        MapError: If a rule is not one of this module: which ids it reads is not known.
    """
    n_views, n = len(change.kept_views), len(change.kept_experiences)
    by_rule: dict[Rule, Callable[[Tensor], Tensor] | None] = {
        about_now: None,
        summed: None,
        rows_of_views: change.rows_of_views,
        rows_of_experiences: change.rows_of_experiences,
        summed_by_view: lambda column: summed_rows(column, change.views, n_views),
        summed_by_experience: lambda column: summed_rows(column, change.experiences, n),
        view_id: lambda number: renamed(number, change.views),
        experience_id: lambda number: renamed(number, change.experiences),
    }
    changed: State = {}
    for name, value in state.items():
        rule = rule_of(name, rules)
        if rule is None or rule not in by_rule:
            raise MapError(f"{name}: its merge rule is not a standard one; define renumber()")
        rows = by_rule[rule]
        if rows is not None:
            changed[name] = rows(value)
    return changed
