"""Registration of populations: each has a kind, and a rule of merging for all that it learns."""

from collections.abc import Callable
from typing import TypeVar

from neuroslam.config import BrainConfig
from neuroslam.config.populations import HOMES, known_kinds, population_class, registered
from neuroslam.errors import ConfigError, MapError
from neuroslam.state.join import Join
from neuroslam.state.mergeable import rule_of
from neuroslam.state.population import Population

Kind = TypeVar("Kind", bound=type[Population])


def register(kind: str) -> Callable[[Kind], Kind]:
    """Make a class known as a population of this kind, for ``cells`` of a config.

    A kind may be registered again by a class of the same name: a notebook's cell is run twice.

    Raises:
        ConfigError: If the kind is no identifier or is another class's, if the class is no
            :class:`~neuroslam.state.population.Population`, or if part of its state has no rule of
            merging.

    Example:
        >>> from neuroslam.state.population import Population
        >>> @register("silent")
        ... class Silent(Population):
        ...     pass
        >>> registered.pop("silent") is Silent
        True
    """

    def add(cls: Kind) -> Kind:
        if not kind.isidentifier() or (kind not in HOMES and kind in BrainConfig.model_fields):
            raise ConfigError(
                f"@register({kind!r}): expected a name like head_direction that is no section of "
                "the config"
            )
        if not (isinstance(cls, type) and issubclass(cls, Population)):
            raise ConfigError(f"@register({kind!r}): {cls!r} is no subclass of Population")
        before = registered.get(kind)
        if before is not None and before.__qualname__ != cls.__qualname__:
            raise ConfigError(
                f"@register({kind!r}): is {before.__module__}.{before.__qualname__} already; "
                "choose another name"
            )
        if kind in HOMES and cls.__module__ != HOMES[kind]:
            raise ConfigError(f"@register({kind!r}): is a population of the package already")
        cls.kind, cls.name = kind, cls.__dict__.get("name", kind)
        registered[kind] = cls
        try:
            if kind not in HOMES:  # the tests look at the package's own: imports stay quick
                _check_merges(cls)
        except ConfigError:
            del registered[kind]
            if before is not None:
                registered[kind] = before
            raise
        return cls

    return add


def _check_merges(cls: type[Population]) -> None:
    """Refuse a population that could lose in a merge what it has learnt."""
    what = f"@register({cls.kind!r})"
    try:
        one, other = (cls.build(BrainConfig(), cls) for _ in range(2))
    except Exception as error:
        raise ConfigError(
            f"{what}: cannot be built from the default config "
            f"({type(error).__name__}: {error}); every parameter needs a default"
        ) from error
    loaded, partial = one.state_dict(), other.state_dict()
    if cls.merged is Population.merged:
        without = [name for name in partial if rule_of(name, cls.merge_rules) is None]
        if without:
            raise ConfigError(
                f"{what}: no rule of merging for {', '.join(without)}; name each in merge_rules, "
                "about_now for what is not learnt, or define merged()"
            )
    try:
        merged = one.merged(loaded, partial, Join.nothing())
    except (MapError, RuntimeError, ValueError, KeyError, IndexError, TypeError) as error:
        raise ConfigError(
            f"{what}: two states without experience do not merge ({type(error).__name__}: {error})"
        ) from error
    if merged.keys() != partial.keys():
        odd = ", ".join(sorted(merged.keys() ^ partial.keys()))
        raise ConfigError(f"{what}: merged() must return every name of the state; check {odd}")


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
