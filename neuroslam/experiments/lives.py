"""Lives of brains over parts of a source, and what happened when maps were joined."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.evaluation.icp import fraction_of_diagonal, map_rmse
from neuroslam.evaluation.trajectory import absolute_trajectory_error, shape_rmse
from neuroslam.figures.sessions import Bindings, Stage
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import trajectory
from neuroslam.types import Frame

_TRACE = ("session", "number", "dx_m", "dy_m", "dtheta_rad", "truth_x_m", "truth_y_m")


class Picture(NamedTuple):
    """A map at one moment.

    Attributes:
        poses: Of the experiences, ``(n, 3)``.
        links: Source and target, ``(m, 2)``.
        cells: Where they are bound, x, y, theta in cells, ``(n, 3)``.
        session: Id of the session that made each, ``(n,)``.
    """

    poses: np.ndarray
    links: np.ndarray
    cells: np.ndarray
    session: np.ndarray

    @classmethod
    def of(cls, experiences: ExperienceMap) -> "Picture":
        """Take it; the map may go on."""
        links, table = experiences.links, experiences.experiences
        return cls(
            experiences.poses,
            np.column_stack([links.source, links.target]),
            table["cell"].numpy().copy(),
            table["session"].numpy().copy(),
        )


class Joint(NamedTuple):
    """A merge: both maps before, the merged one right after, and the report."""

    frame: int
    loaded: Picture
    partial: Picture
    after: Picture
    report: dict[str, Any]


class Life(NamedTuple):
    """One session.

    Attributes:
        brain: At its end.
        trace: Where each frame was, relative to its place, and in truth.
        joints: The merges on the way.
        created_at_known: Places made after the first merge though their view was known.
    """

    brain: NavigationBrain
    trace: dict[str, np.ndarray]
    joints: list[Joint]
    created_at_known: int


@torch.inference_mode()
def live(
    frames: Iterable[Frame],
    config: BrainConfig,
    stored: NavigationBrain | None = None,
    name: str = "",
) -> Life:
    """Let a new brain live through frames, with the maps of another in its memory."""
    brain = NavigationBrain(config)
    brain.about = (name, "", "")
    if stored is not None:
        brain.store(stored)
    rows, joints, created = [], [], 0
    for frame in frames:
        partial, others, merges = brain.map, list(brain.stored), len(brain.sessions.merges)
        result = brain(frame)
        created += bool(joints) and result.action == "create" and not result.view.is_new
        truth = frame.truth or (np.nan, np.nan, np.nan)
        rows.append((*brain.map.origin, *brain.map.offset, *truth[:2]))
        if len(brain.sessions.merges) > merges:
            (loaded,) = (one for one in others if all(one is not left for left in brain.stored))
            joints.append(
                Joint(
                    frame.index,
                    Picture.of(loaded.map),
                    Picture.of(partial),
                    Picture.of(brain.map),
                    brain.sessions.merges[-1],
                )
            )
    table = np.array(rows)
    return Life(brain, dict(zip(_TRACE, table.T, strict=True)), joints, created)


def track(brain: NavigationBrain, lives: list[Life]) -> tuple[np.ndarray, np.ndarray]:
    """Place the frames of lives on a map; positions and true ones, ``(frames, 2)``, NaN if off."""
    found = [trajectory(brain, life.trace)[:, :2] for life in lives]
    truth = [np.column_stack([life.trace[n] for n in ("truth_x_m", "truth_y_m")]) for life in lives]
    return np.concatenate(found), np.concatenate(truth)


def measure(
    name: str, lives: list[Life], single: Life | None, shared: np.ndarray
) -> dict[str, Any]:
    """Say how large a map is and how good, against the truth and the map of a single session.

    Args:
        name: Of the map.
        lives: Sessions, the last of which has the map.
        single: Life of the single session; ``None`` if this is it.
        shared: Numbers of the frames of the single session that ``lives`` lived through.
    """
    brain = lives[-1].brain
    row: dict[str, Any] = {
        "map": name,
        "sessions": len(lives),
        "frames": sum(len(life.trace["session"]) for life in lives),
        "merges": sum(len(life.joints) for life in lives),
        "maps_not_joined": len(brain.stored),
        "templates": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(*brain.map.links[:2]).sum()),
        "places_created_at_known_views_after_merge": sum(life.created_at_known for life in lives),
    }
    found, truth = track(brain, lives)
    if single is not None:
        here, there = brain.map.poses[:, :2], single.brain.map.poses[:, :2]
        for mode in ("rigid", "similarity"):
            rmse = map_rmse(here, there, mode).rmse
            row[f"icp_rmse_{mode}_m"] = rmse
            row[f"icp_rmse_{mode}_of_diagonal"] = fraction_of_diagonal(rmse, there)
        whole = track(single.brain, [single])[0][shared]
        both = np.isfinite(found[:, 0]) & np.isfinite(whole[:, 0])
        row["track_rmse_of_diagonal"] = shape_rmse(found[both], whole[both])
    known = np.isfinite(truth[:, 0]) & np.isfinite(found[:, 0])
    if known.any():
        for mode in ("rigid", "similarity"):
            error = absolute_trajectory_error(found[known], truth[known], mode)
            row[f"ate_{mode}_m"] = error.rmse
    return row


def stage(
    title: str,
    picture: Picture,
    order: list[int],
    merge_xy: np.ndarray | None = None,
    others: tuple = (),
) -> Stage:
    """Make a panel of a picture; sessions are coloured by their place in ``order``."""
    return Stage(
        title,
        picture.poses,
        picture.links,
        np.array([order.index(one) for one in picture.session.tolist()], dtype=np.int64),
        np.zeros((0, 2)) if merge_xy is None else merge_xy,
        others=others,
    )


def stages(single: Life, lives: list[Life]) -> list[Stage]:
    """Make the panels of paper's Figs. 9, 13, 15 and 17: single session, matches, merges, end."""
    alone = Picture.of(single.brain.map)
    panels = [stage("single session", alone, sorted(set(alone.session.tolist())))]
    order = [life.brain.sessions.now.id for life in lives]
    joints = [(i, joint) for i, life in enumerate(lives) for joint in life.joints]
    for k, (i, joint) in enumerate(joints):
        match = joint.report["match"]
        u, z = match["loaded_experience"], match["partial_experience"]
        partial = stage(f"session {i + 1}", joint.partial, order, joint.partial.poses[[z], :2])
        at_u = joint.loaded.poses[[u], :2]
        panels.append(
            stage(
                f"session {i + 1} at the match, frame {joint.frame}",
                joint.loaded,
                order,
                at_u,
                (partial,),
            )
        )
        if k == 0 or len(joints) <= 2:
            panels.append(
                stage("right after the merge", joint.after, order, joint.after.poses[[u], :2])
            )
    final = Picture.of(lives[-1].brain.map)
    return [*panels, stage("at the end", final, order)]


def bindings(single: Life, lives: list[Life]) -> list[Bindings]:
    """Make the panels of paper's Fig. 11: where places are bound, before and after a merge."""
    (i, joint) = next((i, life.joints[0]) for i, life in enumerate(lives) if life.joints)
    order = [life.brain.sessions.now.id for life in lives]
    match = joint.report["match"]
    u, z = match["loaded_experience"], match["partial_experience"]

    def panel(title: str, picture: Picture, matched: np.ndarray, sessions: list[int]) -> Bindings:
        session = [sessions.index(one) for one in picture.session.tolist()]
        return Bindings(title, picture.cells, np.array(session, dtype=np.int64), matched)

    alone, none = Picture.of(single.brain.map), np.zeros((0, 3))
    return [
        panel("single session", alone, none, sorted(set(alone.session.tolist()))),
        panel("stored map", joint.loaded, joint.loaded.cells[[u]], order),
        panel(f"session {i + 1} before the shift", joint.partial, joint.partial.cells[[z]], order),
        panel("merged", joint.after, joint.after.cells[[u]], order),
    ]
