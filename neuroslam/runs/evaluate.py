"""Errors of a run's trajectory against the ground truth, and of its map against another map."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.errors import RunError, counted
from neuroslam.evaluation.icp import IcpMode, fraction_of_diagonal, map_rmse
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    ErrorStatistics,
    absolute_trajectory_error,
    associate,
    read_tum,
    relative_pose_error,
)
from neuroslam.figures.sessions import plot_overlay
from neuroslam.figures.style import save
from neuroslam.runs.files import brain_file
from neuroslam.runs.reading import read_trace, track_file, true_poses
from neuroslam.runs.truth import read_truth


def evaluate(
    track: str | Path,
    truth: str | Path | None = None,
    align: AlignmentMode = "rigid",
    on_note: Callable[[str], None] | None = None,
) -> list[tuple[str, ErrorStatistics, str]]:
    """Compare the trajectory of a run, or of a TUM file, with the ground truth.

    Args:
        track: Folder of a run, or a TUM file.
        truth: TUM file, or CSV (:func:`~neuroslam.runs.truth.read_truth`); not needed for a run
            whose source knows the truth, or that was made with a truth file.
        align: How the track is aligned with the truth before the comparison.
        on_note: Called with a note if frames without a true pose are left out, or headings are
            unknown: there is no relative error then.

    Returns:
        Name of the error, its statistics, its unit.

    Raises:
        NeuroslamError: If a file is missing or damaged, or there is no truth to compare with.
    """
    track = Path(track)
    if align not in get_args(AlignmentMode):
        raise RunError(f"--align {align}: expected one of {', '.join(get_args(AlignmentMode))}")
    out = track if track.is_dir() else None
    found = read_tum(track if out is None else track_file(out))
    if truth is not None:
        true = read_truth(truth)
        i, j = associate(found.times_s, true.times_s)
        estimate, reference = found.poses[i], true.poses[j]
    else:
        trace = None if out is None else read_trace(out, len(found.times_s))
        true_track = None if trace is None else true_poses(trace)
        if trace is None or true_track is None:
            raise RunError(
                f"{track}: its source has no ground truth; give a TUM file or CSV with --truth FILE"
            )
        i, j = associate(found.times_s, trace["time_s"])  # a frame may be on no map
        known = np.isfinite(true_track[j, 0])
        estimate, reference = found.poses[i[known]], true_track[j[known]]
    if len(estimate) < 2:
        check = "" if truth is None else f"; is {truth} the truth of this track?"
        raise RunError(
            f"{track}: a true pose within 0.02 s for {len(estimate)} of "
            f"{counted(len(found.times_s), 'frame')}; expected at least 2 frames{check}"
        )
    n_frames = len(found.times_s)
    if on_note is not None and len(estimate) < n_frames:
        on_note(
            f"{len(estimate)} of {counted(n_frames, 'frame')} have a true pose; "
            "the errors are over those"
        )
    absolute = absolute_trajectory_error(estimate[:, :2], reference[:, :2], align)
    if not np.isfinite(reference[:, 2]).all():
        if on_note is not None:
            on_note("the truth has no headings; there is no relative error")
        return [("absolute (ATE)", absolute, "m")]
    relative = relative_pose_error(estimate, reference)
    return [
        ("absolute (ATE)", absolute, "m"),
        ("relative, per frame", relative.translation_m, "m"),
        ("relative, per frame", relative.rotation_rad, "rad"),
    ]


class MapComparison(NamedTuple):
    """Result of the alignment of one map with another.

    Attributes:
        mode: ``rigid``, or ``similarity`` with a free scale.
        rmse_m: RMSE between the experiences of the map and the nearest of the other, m.
        of_diagonal: The same as a share of the diagonal of the other map.
        turn_deg: Rotation of the map onto the other, degrees.
        scale: Scale of the map onto the other.
    """

    mode: IcpMode
    rmse_m: float
    of_diagonal: float
    turn_deg: float
    scale: float


def compare_maps(
    run: str | Path, other: str | Path, to: str | Path | None = None
) -> tuple[list[MapComparison], Path]:
    """Compare the map of a run with that of another, as the multisession paper does (ICP, RMSE).

    Args:
        run: Folder of a run, or a brain file.
        other: The same, of the map to compare with.
        to: Figure of both maps, rigidly aligned; ``against.png`` beside the first if not given.

    Returns:
        The comparison with a rigid alignment and with a similarity, and the figure.

    Raises:
        NeuroslamError: If a brain cannot be read, or a map has too few experiences.
    """
    files = brain_file(run), brain_file(other)
    maps = [load_brain(file).map for file in files]
    ours, theirs = (each.poses[:, :2] for each in maps)
    rows = []
    modes: tuple[IcpMode, ...] = ("rigid", "similarity")
    for mode in modes:
        found = map_rmse(ours, theirs, mode)
        (c, _), (s, _) = found.alignment.rotation
        rows.append(
            MapComparison(
                mode,
                found.rmse,
                fraction_of_diagonal(found.rmse, theirs),
                math.degrees(math.atan2(s, c)),
                found.alignment.scale,
            )
        )
        if mode == "rigid":
            names = tuple(str(Path(each)) for each in (other, run))
            figure = plot_overlay(
                theirs,
                found.alignment.apply(ours),
                found.rmse,
                rows[0].of_diagonal,
                "Two maps, rigid alignment by ICP",
                *(np.column_stack([m.links.source, m.links.target]) for m in reversed(maps)),
                names=(names[0], f"{names[1]}, aligned"),
            )
    path = Path(to) if to is not None else files[0].parent / "against.png"
    try:
        save(figure, path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror or error})") from None
    return rows, path
