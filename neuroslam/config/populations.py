"""Known populations by kind: the package's own, installed ones, and those of plugin files."""

import importlib
import importlib.util
import os
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from neuroslam.errors import ConfigError, did_you_mean

HOMES = {
    "pose": "neuroslam.cells.pose",
    "place": "neuroslam.cells.navigation",
    "semantic": "neuroslam.spiking.semantic",
    "head_direction": "neuroslam.cells.head_direction",
    "speed": "neuroslam.cells.speed",
}
"""Module of each of the package's own kinds, in the order in which a brain steps them."""

ENTRY_POINTS = "neuroslam.populations"
"""Entry-point group by which an installed package adds populations."""

PLUGINS = "NEUROSLAM_PLUGINS"
"""Environment variable that passes the files of :func:`load_plugin` to processes of a sweep."""

registered: dict[str, type[Any]] = {}
"""Class of each kind whose module has been imported; :mod:`neuroslam.state.registry` fills it."""

_loaded: set[str] = set()


def known_kinds() -> tuple[str, ...]:
    """Return all kinds of populations, the package's own first.

    Example:
        >>> known_kinds()[:3]
        ('pose', 'place', 'semantic')
    """
    _load_plugins_of_parent()
    installed = {point.name for point in entry_points(group=ENTRY_POINTS)}
    return (*HOMES, *sorted((installed | registered.keys()) - HOMES.keys()))


def population_class(kind: str) -> type[Any]:
    """Return the class of a kind; the first call imports its module.

    Raises:
        ConfigError: If no such population is known.
    """
    if kind not in registered and kind in HOMES:
        importlib.import_module(HOMES[kind])
    if kind not in registered:
        _load_plugins_of_parent()
    if kind not in registered:
        for point in entry_points(group=ENTRY_POINTS):
            if point.name == kind:
                point.load()
    if kind not in registered:
        raise ConfigError(
            f"unknown population {kind!r}; there are {', '.join(known_kinds())}"
            f"{did_you_mean(kind, known_kinds())}; give the file that defines another with "
            "--plugin FILE"
        )
    return registered[kind]


def section_class(kind: str) -> type[Any] | None:
    """Return the section class of a population whose section is no field of ``BrainConfig``."""
    return None if kind in ("pose", "place", "semantic") else population_class(kind).config_section


def load_plugin(path: str | Path) -> None:
    """Run a Python file that registers populations; later calls with the same file do nothing.

    Raises:
        ConfigError: If it is missing, cannot be run, or registers nothing.
    """
    file = Path(path).resolve()
    if str(file) in _loaded:
        return
    if not file.is_file():
        raise ConfigError(f"plugin {path}: no such file; expected a Python file with populations")
    before = dict(registered)
    name = f"neuroslam_plugin_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ConfigError(f"plugin {path}: not a Python file; expected one that ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(f"plugin {path}: {type(error).__name__}: {error}") from error
    if registered == before:
        raise ConfigError(f"plugin {path}: registers no population; decorate one with @register")
    _loaded.add(str(file))
    known = os.environ.get(PLUGINS, "").split(os.pathsep)
    os.environ[PLUGINS] = os.pathsep.join(dict.fromkeys([*filter(None, known), str(file)]))


def _load_plugins_of_parent() -> None:
    """Load the plugins of the parent process."""
    for file in filter(None, os.environ.get(PLUGINS, "").split(os.pathsep)):
        load_plugin(file)
