"""Known populations by kind: the package's own, installed ones, and those of plugin files."""

import hashlib
import importlib
import importlib.util
import os
import sys
import traceback
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from neuroslam.errors import ConfigError, did_you_mean, first_line

HOMES = {
    "pose": "neuroslam.cells.pose",
    "place": "neuroslam.cells.navigation",
    "semantic": "neuroslam.spiking.semantic",
    "head_direction": "neuroslam.cells.head_direction",
    "speed": "neuroslam.cells.speed",
    "pose_3d": "neuroslam.cells.pose_3d",
    "clones": "neuroslam.cells.clones",
}
"""Module of each of the package's own kinds, in the order in which a brain steps them."""

ENTRY_POINTS = "neuroslam.populations"
"""Entry-point group by which an installed package adds populations."""

PLUGINS = "NEUROSLAM_PLUGINS"
"""Environment variable that passes the files of :func:`load_plugin` to processes of a sweep."""

registered: dict[str, type[Any]] = {}
"""Class of each kind whose module has been imported; :mod:`neuroslam.state.registry` fills it."""

_loaded: dict[str, bytes] = {}  # files of load_plugin, and what they held


def known_kinds() -> tuple[str, ...]:
    """Return all kinds of populations, the package's own first.

    Example:
        >>> known_kinds()[:3]
        ('pose', 'place', 'semantic')
    """
    _load_plugins_of_parent()
    installed = _installed(tuple(sys.path)).keys()
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
    point = _installed(tuple(sys.path)).get(kind)
    if kind not in registered and point is not None:
        _load_installed(point)
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
    """Run a Python file that registers populations; again only when it has been changed.

    Processes that are started from here load it, too.

    Raises:
        ConfigError: If it is missing, cannot be run, or registers nothing.
    """
    file = Path(path).resolve()
    try:
        text = file.read_bytes()
    except OSError as error:
        why = "no such file" if isinstance(error, FileNotFoundError) else error.strerror
        raise ConfigError(
            f"plugin {path}: {why}; expected a Python file with populations"
        ) from None
    if _loaded.get(str(file)) == text:
        return
    spec = importlib.util.spec_from_file_location(_module_name(file), file)
    if spec is None or spec.loader is None:
        raise ConfigError(f"plugin {path}: not a Python file; expected one that ends in .py")
    module = importlib.util.module_from_spec(spec)
    before, loaded = dict(registered), _loaded.get(str(file))
    sys.modules[spec.name] = module
    _loaded[str(file)] = text  # at once: what it runs may ask for populations itself
    try:
        exec(compile(text, str(file), "exec"), module.__dict__)  # not a cached copy of an old one
        if not any(cls.__module__ == spec.name for cls in registered.values()):
            raise ConfigError(
                f"plugin {path}: registers no population; decorate one with @register"
            )
    except BaseException as error:
        # What it has imported of the package stays: a module registers once.
        for kind in registered.keys() - before.keys() - HOMES.keys():
            del registered[kind]
        registered.update(before)
        if loaded is None:
            del _loaded[str(file)], sys.modules[spec.name]
        else:
            _loaded[str(file)] = loaded
        if isinstance(error, ConfigError | KeyboardInterrupt):
            raise
        raise ConfigError(f"plugin {path}{_line_of(error, file)}: {_said(error)}") from error
    known = os.environ.get(PLUGINS, "").split(os.pathsep)
    os.environ[PLUGINS] = os.pathsep.join(dict.fromkeys([*filter(None, known), str(file)]))


def _module_name(file: Path) -> str:
    """Name the module of a plugin; two files of one name are two modules."""
    name = f"neuroslam_plugin_{file.stem}"
    other = getattr(sys.modules.get(name), "__file__", str(file))
    return (
        name if other == str(file) else f"{name}_{hashlib.sha256(str(file).encode()).hexdigest()}"
    )


def _line_of(error: BaseException, file: Path) -> str:
    lines = [at.lineno for at in traceback.extract_tb(error.__traceback__)
             if at.filename == str(file)]  # fmt: skip
    return f", line {lines[-1]}" if lines else ""


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {first_line(error)}"


@lru_cache(maxsize=8)
def _installed(_path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Find entry points by name; to look through all that is installed takes milliseconds."""
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _load_installed(point: EntryPoint) -> None:
    """Import the module of an installed population.

    Raises:
        ConfigError: If that fails, or does not register it.
    """
    what = f"population {point.name!r} of the installed {point.value}"
    try:
        point.load()
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(f"{what}: cannot be imported ({_said(error)})") from error
    if point.name not in registered:
        raise ConfigError(f"{what}: is not registered; expected @register({point.name!r})")


def _load_plugins_of_parent() -> None:
    """Load the plugins of the parent process."""
    for file in filter(None, os.environ.get(PLUGINS, "").split(os.pathsep)):
        if file not in _loaded:
            load_plugin(file)
