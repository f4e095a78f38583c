"""Registration of populations: each has a kind, and a rule of merging for all that it learns."""

import sys
from collections.abc import Callable
from typing import TypeVar

from torch import nn

from neuroslam.config import BrainConfig, Section
from neuroslam.config.populations import HOMES, known_kinds, population_class, registered
from neuroslam.errors import ConfigError, first_line
from neuroslam.state.answers import HOOKS
from neuroslam.state.join import Join
from neuroslam.state.mergeable import rule_of
from neuroslam.state.population import Population

Kind = TypeVar("Kind", bound=type[Population])

BRAIN_NAMES = frozenset({
    "about", "climb", "clock", "compass", "config", "continuity", "half_taken", "landmarks_m",
    "largest", "leader", "map", "merge", "navigation", "not_joined", "odometry", "parts", "place",
    "populations", "pose_cells", "recognition", "restore", "semantic", "sessions", "start_new_map",
    "store", "stored", "tracker", "view",
})  # fmt: skip
"""Attributes that every brain has, or that populations of the package are: no one else's name."""


def register(kind: str) -> Callable[[Kind], Kind]:
    """Make a class known as a population of this kind, for ``cells`` of a config.

    A kind may be registered again by the same class: a notebook's cell is run twice.

    Raises:
        ConfigError: If the kind is no identifier, or another class's, or means something else
            already; if the class is no :class:`~neuroslam.state.population.Population`, cannot be
            built from defaults, or answers nothing sensible without experience; or if part of its
            state has no rule of merging.

    Example:
        >>> from neuroslam.state.population import Population
        >>> @register("silent")
        ... class Silent(Population):
        ...     pass
        >>> registered.pop("silent") is Silent
        True
    """
    if not isinstance(kind, str):
        raise ConfigError(
            f"@register: got {kind!r}, expected the kind of the population, as @register('visits')"
        )

    def add(cls: Kind) -> Kind:
        what = f"@register({kind!r})"
        if not (isinstance(cls, type) and issubclass(cls, Population)):
            raise ConfigError(f"{what}: {cls!r} is no subclass of Population")
        _check_kind(kind, cls)
        before = registered.get(kind)
        named = {key: cls.__dict__[key] for key in ("kind", "name") if key in cls.__dict__}
        cls.kind, cls.name = kind, named.get("name", kind)
        registered[kind] = cls
        try:
            if kind not in HOMES:  # the tests look at the package's own: imports stay quick
                _check_name(cls)
                _check_section(cls)
                _check_lead(cls)
                _check_empty(cls)
        except ConfigError:
            del registered[kind]
            for key in {"kind", "name"} - named.keys():
                delattr(cls, key)
            for key, value in named.items():
                setattr(cls, key, value)
            if before is not None:
                registered[kind] = before
            raise
        return cls

    return add


def _check_kind(kind: str, cls: type[Population]) -> None:
    """Refuse a kind that means something else already."""
    what = f"@register({kind!r})"
    if kind in HOMES:
        if cls.__module__ != HOMES[kind]:
            raise ConfigError(f"{what}: is a population of the package already")
        return
    if not kind.isidentifier() or "_and_" in kind:
        raise ConfigError(f"{what}: expected a name like head_direction, without _and_")
    if kind in BrainConfig.model_fields or hasattr(BrainConfig, kind):
        raise ConfigError(f"{what}: is a name of the config already; choose another name")
    twice = next((k for k, other in registered.items() if other is cls and k != kind), None)
    if twice is not None:
        raise ConfigError(f"{what}: is registered as {twice!r} already; register a subclass")
    before = registered.get(kind)
    if before is not None and _source(before) != _source(cls):
        raise ConfigError(
            f"{what}: is {before.__module__}.{before.__qualname__} already; choose another name"
        )


def _check_name(cls: type[Population]) -> None:
    """Refuse a name that is another attribute of a brain."""
    others = {other.name: other for kind, other in registered.items() if kind != cls.kind}
    taken = cls.name in BRAIN_NAMES or hasattr(nn.Module, cls.name) or cls.name == "training"
    if taken or cls.name in others or not cls.name.isidentifier() or cls.name[0] == "_":
        whose = f"of {others[cls.name].__qualname__}" if cls.name in others else "of a brain"
        raise ConfigError(
            f"@register({cls.kind!r}): {cls.name!r} cannot name its part of a brain, it is an "
            f"attribute {whose} or none at all; set `name` to another"
        )


def _check_section(cls: type[Population]) -> None:
    """Refuse parameters that are not a section with defaults."""
    what, section = f"@register({cls.kind!r})", cls.config_section
    if section is None:
        return
    if not (isinstance(section, type) and issubclass(section, Section)):
        raise ConfigError(f"{what}: config_section is {section!r}, expected a subclass of Section")
    try:
        section()
    except ValueError as error:
        raise ConfigError(
            f"{what}: {section.__name__} has no defaults ({first_line(error)}); every parameter "
            "needs one"
        ) from error


def _check_lead(cls: type[Population]) -> None:
    """Refuse a leader that does not say what only it knows."""
    hooks = ("decide", "belief", "estimate")
    lacks = [hook for hook in hooks if getattr(cls, hook) is getattr(Population, hook)]
    if cls.rank > 0 and lacks:
        raise ConfigError(
            f"@register({cls.kind!r}): has rank {cls.rank}, but no {', '.join(lacks)}; define what "
            "a leader needs, or leave rank at 0"
        )


def _check_empty(cls: type[Population]) -> None:
    """Refuse a population that could lose what it learns, or is no use before it has learnt."""
    what = f"@register({cls.kind!r})"
    try:
        one, other = (cls.build(BrainConfig(cells=(cls.kind,)), cls) for _ in range(2))
        loaded, partial = one.state_dict(), other.state_dict()
    except Exception as error:
        raise ConfigError(
            f"{what}: cannot be built from the default config ({_said(error)}); every parameter "
            "needs a default"
        ) from error
    strange = sorted(set(cls.growing) - set(dict(one.named_buffers(recurse=False))))
    if strange:
        raise ConfigError(f"{what}: growing names {', '.join(strange)}, which is no buffer of it")
    if cls.merged is Population.merged:
        without = [name for name in partial if rule_of(name, cls.merge_rules) is None]
        if without:
            raise ConfigError(
                f"{what}: no rule of merging for {', '.join(without)}; name each in merge_rules, "
                "about_now for what is not learnt, or define merged()"
            )
    try:
        merged = one.merged(loaded, partial, Join.nothing())
    except Exception as error:
        raise ConfigError(
            f"{what}: two states without experience do not merge ({_said(error)})"
        ) from error
    if not isinstance(merged, dict) or merged.keys() != partial.keys():
        odd = set(merged) ^ partial.keys() if isinstance(merged, dict) else partial.keys()
        raise ConfigError(
            f"{what}: merged() must return every name of the state; check {', '.join(sorted(odd))}"
        )
    for ask, hook in HOOKS.items():
        try:
            ask(one)
        except TypeError as error:
            own = f"{cls.__name__}." in str(error)
            said = str(error) if own else f"{hook}() fails without experience ({_said(error)})"
            raise ConfigError(f"{what}: {said}") from error
        except Exception as error:
            raise ConfigError(
                f"{what}: {hook}() fails without experience ({_said(error)})"
            ) from error


def _source(cls: type) -> tuple[str, str]:
    """Where a class is defined: in a file of any module name, or in a notebook."""
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    return file or cls.__module__, cls.__qualname__


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {first_line(error)}"


def population_classes(config: BrainConfig) -> list[type[Population]]:
    """Return the classes of a brain's populations, in the order of ``config.cells``."""
    return [population_class(kind) for kind in config.cells]


def leading_class(config: BrainConfig) -> type[Population]:
    """Return the class of the population that decides about experiences.

    Raises:
        ConfigError: If none of them can.
    """
    leader = max(population_classes(config), key=lambda cls: cls.rank)
    if not leader.rank:
        can = [kind for kind in known_kinds() if kind in HOMES and population_class(kind).rank]
        raise ConfigError(
            f"cells = {'+'.join(config.cells)}: none of them makes experiences of a map; add one "
            f"of {', '.join(can)}"
        )
    return leader


def check_forgetting(config: BrainConfig) -> None:
    """Refuse a config in which the map forgets, but a population cannot follow.

    Raises:
        ConfigError: If so.
    """
    if not (config.map.max_experiences or config.map.consolidate_passes):
        return
    what, leader = "map.max_experiences and map.consolidate_passes", leading_class(config)
    if not leader.relaxes_map:
        raise ConfigError(
            f"{what} are for maps of views; here {leader.kind} leads, whose experiences are its "
            "own cells; set both to 0, or add pose to cells"
        )
    if "semantic" in config.cells and "views" in config.semantic.landmarks:
        raise ConfigError(
            f"{what} cannot be used with views as landmarks; leave views out of semantic.landmarks"
        )
    for population in population_classes(config):
        own = population.renumber is not Population.renumber
        if not own and population.merged is not Population.merged:
            raise ConfigError(
                f"{what}: population {population.kind} merges in its own way; define renumber() "
                "too, or set both to 0"
            )
