"""Errors of a run's trajectory against the ground truth, and of its map against another map."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.errors import RunError, counted
from neuroslam.evaluation.icp import IcpMode, fraction_of_diagonal, map_rmse
from neuroslam.evaluation.relations import FAR_S, read_relations, relation_errors
from neuroslam.evaluation.storeys import error_in_3d
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    ErrorStatistics,
    absolute_trajectory_error,
    associate,
    read_tum,
    relative_pose_error,
    statistics_of,
)
from neuroslam.evaluation.trajectory import (
    align as align_tracks,
)
from neuroslam.figures.sessions import plot_overlay
from neuroslam.figures.style import save
from neuroslam.runs.files import brain_file
from neuroslam.runs.reading import read_metrics, read_trace, track_file, true_poses
from neuroslam.runs.truth import read_truth

_NOTED_SCALE = 1.1
"""A scale that differs from 1 by more is noted, if it explains most of the error."""


class _Pairs(NamedTuple):
    """Poses of a track and of the truth at the same instants; frames of the track; heights."""

    estimate: np.ndarray
    truth: np.ndarray
    n_frames: int
    heights_m: tuple[np.ndarray, np.ndarray] | None = None  # of both


def evaluate(
    track: str | Path,
    truth: str | Path | None = None,
    align: AlignmentMode | None = None,
    on_note: Callable[[str], object] | None = None,
    axes: str | None = None,
    track_axes: str | None = None,
) -> list[tuple[str, ErrorStatistics, str]]:
    """Compare the trajectory of a run, or of a TUM file, with the ground truth.

    One camera measures no scale: without ``align``, the errors of a run without measured motion
    are those after a similarity alignment, and the rigid one follows.

    Args:
        track: Folder of a run, or a TUM file.
        truth: TUM file, or CSV (:func:`~neuroslam.runs.truth.read_truth`); not needed for a run
            whose source knows the truth, or that was made with a truth file.
        align: How the track is aligned with the truth before the comparison; ``None``: rigid, and
            similarity first for one camera alone.
        on_note: Called with a note if frames have no true pose, headings or the scale are unknown,
            or on how a file was read.
        axes: Axes of the ground plane in the file of truth, see
            :func:`~neuroslam.sensors.axes.parse_axes`; default: x and y.
        track_axes: The same of a TUM file of the track.

    Returns:
        Name of the error, its statistics, its unit. The error in x, y and z is there if the track
        and the truth have heights.

    Raises:
        NeuroslamError: If a file is missing or damaged, or there is no truth to compare with.
    """
    track, note = Path(track), on_note or (lambda _: None)
    if align is not None and align not in get_args(AlignmentMode):
        raise RunError(f"--align {align}: expected one of {', '.join(get_args(AlignmentMode))}")
    pairs = _pairs(track, truth, axes, track_axes, note)
    estimate, reference, n_frames, heights = pairs
    if len(estimate) < 2:
        check = "" if truth is None else f"; is {truth} the truth of this track?"
        raise RunError(
            f"{track}: a true pose within 0.02 s for {len(estimate)} of "
            f"{counted(n_frames, 'frame')}; expected at least 2 frames{check}"
        )
    if len(estimate) < n_frames:
        note(
            f"{len(estimate)} of {counted(n_frames, 'frame')} have truth; the errors are over those"
        )
    lone_camera = track.is_dir() and _measured(track) is False
    if align is None and lone_camera:
        return _of_lone_camera(estimate, reference, note)
    mode: AlignmentMode = align or "rigid"
    absolute = absolute_trajectory_error(estimate[:, :2], reference[:, :2], mode)
    if lone_camera and mode != "similarity":
        note("the scale is unknown, as one camera measures none; --align similarity frees it")
    elif align is None:
        _note_scale(estimate, reference, absolute, note)
    rows = [("absolute (ATE)", absolute, "m")]
    if heights is not None and mode == "rigid":
        rows.append(("absolute in x, y, z", _in_3d(estimate, reference, heights), "m"))
    return [*rows, *_relative(estimate, reference, "m", note)]


def _in_3d(
    estimate: np.ndarray, reference: np.ndarray, heights_m: tuple[np.ndarray, np.ndarray]
) -> ErrorStatistics:
    """Return the absolute error in x, y and z, aligned by a turn about the vertical."""
    points = (
        np.column_stack([xy[:, :2], z])
        for xy, z in zip((estimate, reference), heights_m, strict=True)
    )
    return statistics_of(error_in_3d(*points))


def _pairs(
    track: Path,
    truth: str | Path | None,
    axes: str | None,
    track_axes: str | None,
    note: Callable[[str], object],
) -> _Pairs:
    out = track if track.is_dir() else None
    if track_axes is not None and out is not None:
        raise RunError(f"--track-axes {track_axes}: are those of a TUM file; {track} is a run")
    if axes is not None and truth is None:
        raise RunError(f"--axes {axes}: are those of a file of truth; give --truth FILE too")
    if out is not None:
        found = read_tum(track_file(out))
    else:
        found = read_truth(track, track_axes, note, "--track-axes camera")
    if truth is not None:
        true = read_truth(truth, axes, note)
        i, j = associate(found.times_s, true.times_s)
        heights = None
        if found.heights_m is not None and true.heights_m is not None:
            heights = found.heights_m[i], true.heights_m[j]
        return _Pairs(found.poses[i], true.poses[j], len(found.times_s), heights)
    trace = None if out is None else read_trace(out, len(found.times_s))
    true_track = None if trace is None else true_poses(trace)
    if trace is None or true_track is None:
        raise RunError(
            f"{track}: its source has no ground truth; give a TUM file or CSV with --truth FILE"
        )
    i, j = associate(found.times_s, trace["time_s"])  # a frame may be on no map
    known = np.isfinite(true_track[j, 0])
    return _Pairs(found.poses[i[known]], true_track[j[known]], len(found.times_s))


def _measured(out: Path) -> bool | None:
    """Return whether a run had measured motion; ``None`` if its figures do not say it."""
    try:
        return read_metrics(out).get("measured_motion")
    except RunError:
        return None


def _of_lone_camera(
    estimate: np.ndarray, reference: np.ndarray, note: Callable[[str], object]
) -> list[tuple[str, ErrorStatistics, str]]:
    """Return the errors with a free scale, then the absolute one without."""
    scale = align_tracks(estimate[:, :2], reference[:, :2], "similarity").scale
    note(
        f"the scale is unknown, as one camera measures none: 1 unit of the map is {scale:.4g} m of "
        "the truth; the errors with that scale come first"
    )
    scaled = estimate * [scale, scale, 1.0]
    both = [
        (f"ATE ({mode})", absolute_trajectory_error(xy[:, :2], reference[:, :2], "rigid"))
        for mode, xy in (("similarity", scaled), ("rigid", estimate))
    ]
    (first, free), (second, rigid) = both
    return [
        (first, free, "m"),
        *_relative(scaled, reference, "m", note),
        (second, rigid, "arbitrary"),
    ]


def _relative(
    estimate: np.ndarray, reference: np.ndarray, unit: str, note: Callable[[str], object]
) -> list[tuple[str, ErrorStatistics, str]]:
    if not np.isfinite(reference[:, 2]).all():
        note("the truth has no headings; there is no relative error")
        return []
    relative = relative_pose_error(estimate, reference)
    return [
        ("relative, per frame", relative.translation_m, unit),
        ("relative, per frame", relative.rotation_rad, "rad"),
    ]


def _note_scale(
    estimate: np.ndarray,
    reference: np.ndarray,
    rigid: ErrorStatistics,
    note: Callable[[str], object],
) -> None:
    """Note a scale of the track that explains most of the error: one camera measures none."""
    scale = align_tracks(estimate[:, :2], reference[:, :2], "similarity").scale
    if scale <= 0.0 or abs(np.log(scale)) < np.log(_NOTED_SCALE):
        return
    free = absolute_trajectory_error(estimate[:, :2], reference[:, :2], "similarity")
    if 2.0 * free.rmse < rigid.rmse:
        note(
            f"the truth is {scale:.4g} times as large as the track; with that scale the ATE is "
            f"{free.rmse:.4f} m (--align similarity)"
        )


def evaluate_relations(
    track: str | Path, relations: str | Path
) -> list[tuple[str, int, float, float]]:
    """Compare a trajectory with true relative poses, by the metric of Kuemmerle et al.

    Args:
        track: Folder of a run, or a TUM file.
        relations: File of relations, see :func:`~neuroslam.evaluation.relations.read_relations`.

    Returns:
        For all relations, and for those that span more than 100 s: name, number, mean error of the
        position (m) and of the heading (degrees).

    Raises:
        NeuroslamError: If a file is missing or damaged, or no relation has poses.
    """
    path = Path(track)
    found = read_tum(track_file(path) if path.is_dir() else path)
    errors = relation_errors(found.times_s, found.poses, read_relations(relations))
    rows = []
    for name, chosen in (
        ("all", np.ones(len(errors.far), dtype=bool)),
        (f"over more than {FAR_S:g} s", errors.far),
    ):
        if chosen.any():
            metres = float(errors.translation_m[chosen].mean())
            degrees = math.degrees(float(errors.rotation_rad[chosen].mean()))
            rows.append((name, int(chosen.sum()), metres, degrees))
    return rows


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
    maps = [load_brain(file).largest.map for file in files]
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
