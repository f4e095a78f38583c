"""Errors of a run's trajectory against the ground truth."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

from neuroslam.errors import RunError, counted
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    ErrorStatistics,
    absolute_trajectory_error,
    associate,
    read_tum,
    relative_pose_error,
)
from neuroslam.runs.reading import read_trace, track_file, true_poses


def evaluate(
    track: str | Path,
    truth: str | Path | None = None,
    align: AlignmentMode = "rigid",
    on_note: Callable[[str], None] | None = None,
) -> list[tuple[str, ErrorStatistics, str]]:
    """Compare the trajectory of a run, or of a TUM file, with the ground truth.

    Args:
        track: Folder of a run, or a TUM file.
        truth: TUM file; not needed for a run whose source knows the truth.
        align: How the track is aligned with the truth before the comparison.
        on_note: Called with a note if frames without a true pose are left out.

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
        true = read_tum(Path(truth))
        i, j = associate(found.times_s, true.times_s)
        estimate, reference = found.poses[i], true.poses[j]
    else:
        trace = None if out is None else read_trace(out, len(found.times_s))
        true_track = None if trace is None else true_poses(trace)
        if trace is None or true_track is None:
            raise RunError(
                f"{track}: its source has no ground truth; give a TUM file with --truth FILE"
            )
        i, j = associate(found.times_s, trace["time_s"])  # a frame may be on no map
        estimate, reference = found.poses[i], true_track[j]
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
    relative = relative_pose_error(estimate, reference)
    return [
        (
            "absolute (ATE)",
            absolute_trajectory_error(estimate[:, :2], reference[:, :2], align),
            "m",
        ),
        ("relative, per frame", relative.translation_m, "m"),
        ("relative, per frame", relative.rotation_rad, "rad"),
    ]
