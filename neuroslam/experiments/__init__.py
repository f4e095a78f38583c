"""Experiments of the papers; each writes ``results.json`` and its figures into a folder."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuroslam.errors import RunError, did_you_mean

if TYPE_CHECKING:
    from neuroslam.experiments.reproduce import Line

_SESSIONS = "neuroslam.experiments.multisession"

_RECOGNITION = "neuroslam.experiments.place_recognition"

EXPERIMENTS = {
    "corridor-loops": ("neuroslam.experiments.corridor_loops", "corridor_loops", "tuc_slam"),
    "view-matching": ("neuroslam.experiments.view_matching", "view_matching", "rtabmap_corridor"),
    "vpr-corridor": (_RECOGNITION, "vpr_corridor", "vpr_corridor"),
    "rtabmap-corridor": (_RECOGNITION, "rtabmap_corridor", "rtabmap_corridor"),
    "odometry-drift": ("neuroslam.experiments.odometry_drift", "odometry_drift", None),
    "laser-robots": ("neuroslam.experiments.laser_robots", "laser_robots", "radish"),
    "virtual-tour": (_SESSIONS, "virtual_tour", None),
    "virtual-tour-no-shift": (_SESSIONS, "virtual_tour_no_shift", None),
    "lab-tour": (_SESSIONS, "lab_tour", None),
    "five-sessions": (_SESSIONS, "five_sessions", None),
    "campus": (_SESSIONS, "campus", None),
    "live-fleet": ("neuroslam.experiments.live_fleet", "live_fleet", None),
    "real-two-sessions": (_SESSIONS, "real_two_sessions", "."),
    "merging-pairs": ("neuroslam.experiments.merging_pairs", "merging_pairs", "."),
    "compare": ("neuroslam.experiments.compare", "compare", None),
    "pixel-landmarks": ("neuroslam.experiments.compare", "pixel_landmarks", None),
    "populations": ("neuroslam.experiments.populations", "populations", None),
    "boundary-scenarios": (
        "neuroslam.experiments.boundary_cells",
        "boundary_scenarios",
        None,
    ),
    "boundary-cells": (
        "neuroslam.experiments.boundary_sheet",
        "boundary_cells_in_loop",
        "rodent",
    ),
    "head-direction": ("neuroslam.experiments.head_direction", "head_direction", None),
    "lost-compass": ("neuroslam.experiments.lost_compass", "lost_compass", None),
    "three-dimensions": ("neuroslam.experiments.three_dimensions", "three_dimensions", None),
    "same-places": ("neuroslam.experiments.same_places", "same_places", None),
    "alike-pairs": ("neuroslam.experiments.alike_pairs", "alike_pairs", None),
    "grid-scores": ("neuroslam.experiments.grid_cells", "grid_scores", "rodent"),
    "grid-comparison": ("neuroslam.experiments.grid_comparison", "grid_comparison", "rodent"),
    "grid-learning": ("neuroslam.experiments.grid_learning", "grid_learning", "rodent"),
    "place-map": ("neuroslam.experiments.place_cells", "place_map", "rodent"),
    "place-bump": ("neuroslam.experiments.place_bump", "place_bump", "rodent"),
    "semantic-maps": ("neuroslam.experiments.semantic_maps", "semantic_maps", None),
    "ssp-map": ("neuroslam.experiments.ssp_map", "ssp_map", None),
    "ssp-activity": ("neuroslam.experiments.ssp_activity", "ssp_activity", "rodent"),
    "ssp-localisation": ("neuroslam.experiments.ssp_localisation", "ssp_localisation", None),
    "ssp-3d": ("neuroslam.experiments.ssp_localisation", "ssp_3d", None),
    "ssp-kitti": ("neuroslam.experiments.ssp_kitti", "ssp_kitti", "kitti_00"),
    "threshold-sweep": ("neuroslam.experiments.place_cells", "threshold_sweep", "rodent"),
}
"""Name -> module, function, and folder of its recordings in the data, or ``None``."""

_OPTIONAL = {"ssp-localisation": "ssp", "odometry-drift": "."}
"""Name -> folder of recordings that are used if present; otherwise random ones are generated."""


def run_experiment(
    name: str,
    data: Path | None,
    out: Path,
    jobs: int | None = None,
    ray: str | None = None,
    networks: Mapping[str, Path] | None = None,
    sequence: str | None = None,
    arguments: Mapping[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """Run an experiment and return its rows; their keys carry units.

    Args:
        name: One of ``EXPERIMENTS``.
        data: Folder that holds the folders of the recordings; ``None`` if not needed.
        out: Folder to write.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`, for independent simulations.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.
        networks: ``view.features`` -> file of weights, for experiments that compare views.
        sequence: Number of a KITTI sequence, for experiments on one; ``None``: 00.
        arguments: Further arguments of the experiment's function, such as ``minutes``.

    Raises:
        RunError: If there is no such experiment, its recording is missing, or it has no independent
            simulations, views or sequences for ``jobs``, ``ray``, ``networks`` or ``sequence``.
    """
    if name not in EXPERIMENTS:
        raise RunError(
            f"no experiment {name!r}; there are {', '.join(EXPERIMENTS)}"
            f"{did_you_mean(name, EXPERIMENTS)}"
        )
    module, function, folder = EXPERIMENTS[name]
    experiment = getattr(import_module(module), function)
    options: dict[str, Any] = dict(arguments or {})
    if sequence is not None:
        from neuroslam.worlds.landmark_paths import KITTI_SEQUENCES

        if "sequence" not in signature(experiment).parameters:
            raise RunError(f"{name}: has one recording only; leave --sequence out")
        if sequence not in KITTI_SEQUENCES:
            raise RunError(
                f"{name}: no sequence {sequence!r} with published poses; expected one of "
                f"{', '.join(KITTI_SEQUENCES)}"
            )
        options["sequence"] = sequence
        folder = _folder_of(folder, sequence, data)
    recordings = None
    if folder is None and data is not None and name in _OPTIONAL:
        optional = Path(data) / _OPTIONAL[name]
        recordings = optional if optional.is_dir() else None
    if folder is not None:
        if data is None:
            raise RunError(f"{name}: needs a recording; give the folder that holds it with --data")
        recordings = Path(data) / folder
        if not recordings.is_dir():
            raise RunError(f"{recordings}: no such recording; give its parent folder with --data")
    if networks:
        if "networks" not in signature(experiment).parameters:
            raise RunError(f"{name}: compares no views; leave --network out")
        options["networks"] = networks
    if jobs is not None or ray is not None:
        if "jobs" not in signature(experiment).parameters:
            raise RunError(f"{name}: cannot run in parallel; leave --jobs and --ray out")
        options |= {"jobs": jobs, "ray": ray}
    rows: list[dict[str, Any]] = experiment(recordings, Path(out), **options)["rows"]
    return rows


def run_all(
    data: Path | None,
    out: Path,
    *,
    quick: bool = False,
    names: Sequence[str] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> "list[Line]":
    """Run every experiment that holds values of the papers, and write one page about them.

    See :func:`neuroslam.experiments.reproduce.reproduce`.

    Args:
        data: Folder that holds the folders of the recordings; ``None``: experiments that need one
            are lines without a value.
        out: Folder to write.
        quick: The smaller size, minutes in place of hours.
        names: Experiments to run; ``None``: all.
        say: Called with the name of each experiment before it runs.
    """
    from neuroslam.experiments.reproduce import reproduce

    def run(name: str, folder: Path, arguments: Mapping[str, Any]) -> None:
        run_experiment(name, data, folder, arguments=arguments)

    return reproduce(run, out, quick=quick, names=names, say=say)


def _folder_of(folder: str | None, sequence: str, data: Path | None) -> str | None:
    """Return the folder of a sequence in the data: its own, or the data itself."""
    own = None if folder is None else f"{folder.rpartition('_')[0]}_{sequence}"
    if own is None or data is None or (Path(data) / own).is_dir():
        return own
    return "." if (Path(data) / "poses").is_dir() else own
