"""Runs of brains over parts of a source, with the maps before and after each merge."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.evaluation.icp import IcpMode, fraction_of_diagonal, map_rmse
from neuroslam.evaluation.trajectory import absolute_trajectory_error, shape_rmse
from neuroslam.figures.sessions import Bindings, Stage
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.reading import trajectory
from neuroslam.types import Frame

_MODES: tuple[IcpMode, ...] = ("rigid", "similarity")
_TRACE = ("session", "number", "dx_m", "dy_m", "dtheta_rad", "truth_x_m", "truth_y_m")


class MapSnapshot(NamedTuple):
    """A copy of a map at one moment.

    Attributes:
        poses: Poses of the experiences, ``(n, 3)``.
        links: Source and target of each link, ``(m, 2)``.
        cells: Bindings to the pose cells: x, y, theta in cells, ``(n, 3)``.
        session: Id of the session that made each experience, ``(n,)``.
    """

    poses: np.ndarray
    links: np.ndarray
    cells: np.ndarray
    session: np.ndarray

    @classmethod
    def of(cls, experiences: ExperienceMap) -> "MapSnapshot":
        """Copy a map."""
        links, table = experiences.links, experiences.experiences
        return cls(
            experiences.poses,
            np.column_stack([links.source, links.target]),
            table["cell"].numpy().copy(),
            table["session"].numpy().copy(),
        )


class MergeSnapshots(NamedTuple):
    """A merge: both maps before it, the merged map after it, and the report."""

    frame: int
    loaded: MapSnapshot
    partial: MapSnapshot
    after: MapSnapshot
    report: dict[str, Any]


class SessionRun(NamedTuple):
    """One session.

    Attributes:
        brain: The brain at the end.
        trace: Offset of each frame from its experience, and true position.
        merge_snapshots: The merges of the session.
        created_at_known_views: Experiences created at known views after the first merge.
    """

    brain: NavigationBrain
    trace: dict[str, np.ndarray]
    merge_snapshots: list[MergeSnapshots]
    created_at_known_views: int


class SessionRecorder:
    """A session that is stepped frame by frame, so that several can take the same frames.

    Args:
        config: Of the brain.
        stored: Brain whose maps are stored in the new one.
        name: Name of the source.
    """

    def __init__(
        self, config: BrainConfig, stored: NavigationBrain | None = None, name: str = ""
    ) -> None:
        self.brain = NavigationBrain(config)
        self.brain.about = (name, "", "")
        if stored is not None:
            self.brain.store(stored)
        self._rows: list[tuple[float, ...]] = []
        self._created = 0
        self._merges: list[MergeSnapshots] = []

    @torch.inference_mode()
    def step(self, frame: Frame) -> None:
        """Advance the brain by a frame, and note its map around a merge."""
        brain = self.brain
        partial, others, merges = brain.map, list(brain.stored), len(brain.sessions.merges)
        result = brain(frame)
        new = result.action == "create" and not result.view.is_new
        self._created += bool(self._merges) and new
        truth = frame.truth or (np.nan, np.nan, np.nan)
        self._rows.append((*brain.map.origin, *brain.map.offset, *truth[:2]))
        if len(brain.sessions.merges) > merges:
            (loaded,) = (one for one in others if all(one is not left for left in brain.stored))
            self._merges.append(
                MergeSnapshots(
                    frame.index,
                    MapSnapshot.of(loaded.map),
                    MapSnapshot.of(partial),
                    MapSnapshot.of(brain.map),
                    brain.sessions.merges[-1],
                )
            )

    def result(self) -> SessionRun:
        """Return the session so far."""
        columns: list[np.ndarray] = [*np.array(self._rows).T]
        trace: dict[str, np.ndarray] = dict(zip(_TRACE, columns, strict=True))
        return SessionRun(self.brain, trace, list(self._merges), self._created)


def run_session(
    frames: Iterable[Frame],
    config: BrainConfig,
    stored: NavigationBrain | None = None,
    name: str = "",
) -> SessionRun:
    """Run a new brain on frames, with the maps of another stored in it."""
    session = SessionRecorder(config, stored, name)
    for frame in frames:
        session.step(frame)
    return session.result()


def track(brain: NavigationBrain, runs: list[SessionRun]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions on a map and true positions of the frames of runs, ``(frames, 2)``.

    Frames that are not on the map have NaN.
    """
    found = [trajectory(brain, run.trace)[:, :2] for run in runs]
    truth = [np.column_stack([run.trace[n] for n in ("truth_x_m", "truth_y_m")]) for run in runs]
    return np.concatenate(found), np.concatenate(truth)


def measure(
    name: str, runs: list[SessionRun], single: SessionRun | None, shared: np.ndarray
) -> dict[str, Any]:
    """Measure the size of a map, and its errors against the truth and a single session.

    Args:
        name: Name of the map.
        runs: Sessions; the last one has the map.
        single: Run of the single session; ``None`` if this is it.
        shared: Frames of the single session that ``runs`` have too.
    """
    brain = runs[-1].brain
    row: dict[str, Any] = {
        "map": name,
        "sessions": len(runs),
        "frames": sum(len(run.trace["session"]) for run in runs),
        "merges": sum(len(run.merge_snapshots) for run in runs),
        "maps_not_joined": len(brain.stored),
        "templates": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(*brain.map.links[:2]).sum()),
        "places_created_at_known_views_after_merge": sum(
            run.created_at_known_views for run in runs
        ),
    }
    found, truth = track(brain, runs)
    if single is not None:
        here, there = brain.map.poses[:, :2], single.brain.map.poses[:, :2]
        for mode in _MODES:
            rmse = map_rmse(here, there, mode).rmse
            row[f"icp_rmse_{mode}_m"] = rmse
            row[f"icp_rmse_{mode}_of_diagonal"] = fraction_of_diagonal(rmse, there)
        whole = track(single.brain, [single])[0][shared]
        both = np.isfinite(found[:, 0]) & np.isfinite(whole[:, 0])
        row["track_rmse_of_diagonal"] = shape_rmse(found[both], whole[both])
    known = np.isfinite(truth[:, 0]) & np.isfinite(found[:, 0])
    if known.any():
        for mode in _MODES:
            error = absolute_trajectory_error(found[known], truth[known], mode)
            row[f"ate_{mode}_m"] = error.rmse
    return row


def stage(
    title: str,
    snapshot: MapSnapshot,
    order: list[int],
    merge_xy: np.ndarray | None = None,
    others: tuple[Stage, ...] = (),
) -> Stage:
    """Return a panel of a snapshot; sessions are coloured by their position in ``order``."""
    return Stage(
        title,
        snapshot.poses,
        snapshot.links,
        np.array([order.index(one) for one in snapshot.session.tolist()], dtype=np.int64),
        np.zeros((0, 2)) if merge_xy is None else merge_xy,
        others=others,
    )


def stages(single: SessionRun, runs: list[SessionRun]) -> list[Stage]:
    """Return the panels of the paper's Figs. 9, 13, 15 and 17: single session, merges, end."""
    alone = MapSnapshot.of(single.brain.map)
    panels = [stage("single session", alone, sorted(set(alone.session.tolist())))]
    order = [run.brain.sessions.now.id for run in runs]
    merge_snapshots = [(i, merge) for i, run in enumerate(runs) for merge in run.merge_snapshots]
    for k, (i, merge) in enumerate(merge_snapshots):
        match = merge.report["match"]
        u, z = match["loaded_experience"], match["partial_experience"]
        partial = stage(f"session {i + 1}", merge.partial, order, merge.partial.poses[[z], :2])
        at_u = merge.loaded.poses[[u], :2]
        panels.append(
            stage(
                f"session {i + 1} at the match, frame {merge.frame}",
                merge.loaded,
                order,
                at_u,
                (partial,),
            )
        )
        if k == 0 or len(merge_snapshots) <= 2:
            panels.append(stage("after the merge", merge.after, order, merge.after.poses[[u], :2]))
    final = MapSnapshot.of(runs[-1].brain.map)
    return [*panels, stage("at the end", final, order)]


def bindings(single: SessionRun, runs: list[SessionRun]) -> list[Bindings]:
    """Return the panels of the paper's Fig. 11: bindings before and after a merge."""
    (i, merge) = next(
        (i, run.merge_snapshots[0]) for i, run in enumerate(runs) if run.merge_snapshots
    )
    order = [run.brain.sessions.now.id for run in runs]
    match = merge.report["match"]
    u, z = match["loaded_experience"], match["partial_experience"]

    def panel(
        title: str, snapshot: MapSnapshot, matched: np.ndarray, sessions: list[int]
    ) -> Bindings:
        session = [sessions.index(one) for one in snapshot.session.tolist()]
        return Bindings(title, snapshot.cells, np.array(session, dtype=np.int64), matched)

    alone, none = MapSnapshot.of(single.brain.map), np.zeros((0, 3))
    return [
        panel("single session", alone, none, sorted(set(alone.session.tolist()))),
        panel("stored map", merge.loaded, merge.loaded.cells[[u]], order),
        panel(f"session {i + 1} before the shift", merge.partial, merge.partial.cells[[z]], order),
        panel("merged", merge.after, merge.after.cells[[u]], order),
    ]
