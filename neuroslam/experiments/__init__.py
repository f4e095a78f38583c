"""Experiments on recordings: each writes ``results.json`` and its figures into a folder."""

from importlib import import_module
from pathlib import Path
from typing import Any

from neuroslam.errors import RunError

EXPERIMENTS = {
    "corridor-loops": ("neuroslam.experiments.corridor_loops", "corridor_loops", "tuc_slam"),
    "view-matching": ("neuroslam.experiments.view_matching", "view_matching", "rtabmap_corridor"),
}
"""Name -> module, function, folder of its recording."""


def run_experiment(name: str, data: Path, out: Path) -> list[dict[str, Any]]:
    """Run an experiment; returns its rows, with named, unit-carrying keys.

    Args:
        name: One of ``EXPERIMENTS``.
        data: Folder that holds the folders of the recordings.
        out: Folder to write.

    Raises:
        RunError: If there is no such experiment, or its recording is not there.
    """
    if name not in EXPERIMENTS:
        raise RunError(f"no experiment {name!r}; there are {', '.join(EXPERIMENTS)}")
    module, function, folder = EXPERIMENTS[name]
    if not (Path(data) / folder).is_dir():
        raise RunError(f"{Path(data) / folder}: no such recording; say where with --data")
    result = getattr(import_module(module), function)(Path(data) / folder, Path(out))
    return result["rows"]
