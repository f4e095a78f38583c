"""Results of a run: its summary, and the files that are written at its end."""

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.brain import NavigationBrain, save_brain
from neuroslam.config import to_toml
from neuroslam.errors import MapError
from neuroslam.evaluation.trajectory import Track, absolute_trajectory_error, write_tum
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import (
    RunPlan,
    experiences_csv,
    links_csv,
    run_files,
    write_text,
)
from neuroslam.runs.heights import frame_heights
from neuroslam.runs.manifest import ROWS, Extent, extent_of, write_manifest
from neuroslam.runs.plot import draw_map
from neuroslam.runs.reading import (
    odometry_track,
    read_metrics,
    read_trace,
    trajectory,
    true_poses,
    unit_of,
)
from neuroslam.runs.sanity import is_animal, unit_warnings
from neuroslam.runs.saves import Folder
from neuroslam.state.activity import ACTIVITY
from neuroslam.state.answers import RUN_FIGURES, counts_of, gathered, tables_of


@dataclass
class RunSummary:
    """Summary of a run: the content of ``metrics.json``, and the frames added by this call."""

    frames: int = 0
    added: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    skipped: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    pictures: bool = False
    measured: bool | None = None
    interrupted: bool = False
    counts: dict[str, float] = field(default_factory=dict)
    accuracy: dict[str, float] = field(default_factory=dict)
    merges: list[dict[str, Any]] = field(default_factory=list)
    refusals: list[dict[str, Any]] = field(default_factory=list)
    not_joined: list[dict[str, Any]] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    unplaced: int = 0
    failure: str = ""
    bad_frame: bool = False

    @property
    def cells(self) -> dict[str, float]:
        """What the populations count, by name."""
        return {name: n for name, n in self.counts.items() if name not in RUN_FIGURES}

    def to_dict(self) -> dict[str, Any]:
        """Return all figures by name; the name ends with the unit."""
        return {
            "frames": self.frames,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "frames_per_s": self.frames / self.seconds if self.seconds else 0.0,
            "frames_per_cpu_s": self.frames / self.cpu_seconds if self.cpu_seconds else 0.0,
            **self.counts,
            "merges": len(self.merges),
            "merge_reports": self.merges,
            "refused_merges": self.refusals,
            "not_joined": self.not_joined,
            "frames_on_no_joined_map": self.unplaced,
            "skipped_frames": len(self.skipped),
            "skipped": self.skipped,
            "unused": self.unused,
            "notes": self.notes,
            "warnings": self.warnings,
            "pictures": self.pictures,
            "measured_motion": self.measured,
            "tables": self.tables,
            "interrupted": self.interrupted,
            **self.accuracy,
        }


class RunSaver:
    """Saves a run: everything from which it can be resumed becomes visible together.

    Args:
        folder: The folder of the run, locked.
        rows_in: Where the files with one row per frame are: ``folder.out``, or ``folder.staged``
            until the first save, where it replaces an earlier run.
    """

    def __init__(self, folder: Folder, rows_in: Path) -> None:
        self.folder, self.rows_in = folder, rows_in
        self.rows: Callable[[], dict[str, Extent]] = self._measured_rows
        self.ended = False  # the activity that was recorded will not grow

    def _measured_rows(self) -> dict[str, Extent]:
        return {name: extent_of(self.rows_in / name) for name in ROWS}

    def __call__(self, brain: NavigationBrain, plan: RunPlan, summary: RunSummary) -> None:
        """Save the run as it is now, with the files that are prepared in the folder already.

        Files of an earlier save that are not part of this one are removed with it.
        """
        out, staged = self.folder.out, self.folder.staged
        write_text(staged / "config.toml", to_toml(brain.config) + plan.to_toml())
        write_text(staged / "metrics.json", json.dumps(summary.to_dict(), indent=2) + "\n")
        save_brain(brain, staged / "brain.safetensors")
        activity = self.rows_in / ACTIVITY
        write_manifest(staged, self.rows(), activity if self.ended and activity.is_dir() else None)
        growing = ("events", ACTIVITY)
        stale = {*run_files(out), *growing}
        self.folder.commit(stale.difference((*ROWS, *growing) if self.rows_in == out else ()))
        self.rows_in = out


def write_results(
    brain: NavigationBrain, plan: RunPlan, save: RunSaver, summary: RunSummary
) -> RunSummary:
    """Write the files at the end of a run, and save it.

    Args:
        brain: The brain at the end of the run.
        plan: Source and range of the run.
        save: Writes the save; its rows are those of the whole run.
        summary: Summary so far; it is completed and returned.

    Raises:
        OSError: If the folder cannot be written.
    """
    save.rows()  # flushes them
    trace = read_trace(save.rows_in, min_rows=0)
    shown = brain.largest
    track = trajectory(shown, trace)
    truth = true_poses(trace)
    odometry = odometry_track(brain.config, trace)
    on_map = np.isfinite(track[:, 0])
    summary.unplaced = int((~on_map).sum())
    drive = brain.sessions.this_drive() if brain.sessions.sessions else set()
    for name in ("merges", "refusals"):
        reports = getattr(brain.sessions, name)
        setattr(summary, name, [r for r in reports if r["partial_sessions"][-1] in drive])
    summary.not_joined = brain.not_joined()
    summary.frames = brain.clock.frames_seen
    summary.counts = {
        "templates": shown.view.n,
        "experiences": shown.map.n,
        "links": shown.map.n_links,
        "loop_closures": int(closes_loop(*shown.map.links[:2]).sum()),
    }
    summary.counts |= gathered(shown.populations.values(), counts_of)
    if summary.measured:
        summary.warnings = unit_warnings(trace, is_animal(plan.source, brain.config))
    tables = gathered(shown.populations.values(), tables_of)
    summary.tables = list(tables)
    if truth is not None:
        known = on_map & np.isfinite(truth[:, 0])
        # A robot that did not move: the alignment with the truth is undetermined.
        with contextlib.suppress(MapError):
            summary.accuracy = {
                f"{name}_rmse_m": absolute_trajectory_error(
                    xy[known, :2], truth[known, :2], "rigid"
                ).rmse
                for name, xy in (("ate", track), ("odometry_ate", odometry))
            }
            if plan.truth or summary.measured is False:  # one camera has no metres: free scale
                summary.accuracy["ate_similarity_rmse_m"] = absolute_trajectory_error(
                    track[known, :2], truth[known, :2], "similarity"
                ).rmse
            summary.accuracy["frames_with_truth"] = int(known.sum())
    staged = save.folder.staged
    write_text(staged / "experiences.csv", experiences_csv(shown))
    write_text(staged / "links.csv", links_csv(shown.map.links, shown.map.link_weights))
    for name, table in tables.items():
        write_text(staged / name, table)
    z_m = frame_heights(shown, trace, save.rows_in)
    heights = None if z_m is None else z_m[on_map]
    write_tum(staged / "trajectory.tum", Track(trace["time_s"][on_map], track[on_map], heights))
    draw_map(brain, plan, trace, staged / "map.png", unit_of(summary.measured))
    save.ended = True
    save(brain, plan, summary)
    return summary


def read_summary(out: Path) -> RunSummary:
    """Read the part of a summary that a resumed run continues.

    Raises:
        RunError: If ``metrics.json`` is missing or damaged.
    """
    old = read_metrics(out)
    return RunSummary(
        seconds=float(old["seconds"]),
        cpu_seconds=float(old["cpu_seconds"]),
        skipped=list(old["skipped"]),
        notes=list(old.get("notes", ())),
        pictures=bool(old.get("pictures")),
        measured=old.get("measured_motion"),
    )
