"""A brain forgets: experiences that are not needed become part of others, in all its parts."""

from collections.abc import Callable

import numpy as np

from neuroslam.brain.state import BrainState
from neuroslam.geometry import relative_poses
from neuroslam.state.renumbering import Renumbering
from neuroslam.types import NO_TEMPLATE

_SAMPLE = 64
"""Templates, evenly spread, that show how unlike the views of different places are."""


def forget(brain: BrainState) -> bool:
    """Forget what a map has too much of, if it is time to; return whether ids have changed."""
    map_, config, changed = brain.map, brain.config.map, False
    if config.consolidate_passes:
        root = map_.to_consolidate(_held(brain), _comparison(brain))
        if root is not None and (root != np.arange(map_.n)).any():
            renumber(brain, root)
            changed = True
    if 0 < config.max_experiences < map_.n:
        renumber(brain, map_.to_forget(_held(brain)))
        changed = True
    return changed


def _held(brain: BrainState) -> list[int]:
    """Return the ends of a loop closure that may have to be undone."""
    tracker = brain.tracker
    return [] if tracker is None else [tracker.state.origin, tracker.state.joined]


def renumber(brain: BrainState, root: np.ndarray) -> None:
    """Let experiences become part of others, and drop the templates that none has any more.

    Args:
        brain: The brain; all its parts follow.
        root: Experience that each is part of from now on, itself if it is kept, ``(n,)``.
    """
    change = renumbering(brain, root)
    for part in brain.parts().values():
        part.renumber(change)


def renumbering(brain: BrainState, root: np.ndarray) -> Renumbering:
    """Return how ids change if experiences become part of others; arguments as above."""
    templates, poses = brain.map.experiences.array("template"), brain.map.pose_table
    kept = np.flatnonzero(root == np.arange(len(root)))
    numbers = np.full(len(root), -1)
    numbers[kept] = np.arange(len(kept))
    used = np.zeros(brain.view.n, dtype=bool)
    used[templates[kept][templates[kept] != NO_TEMPLATE]] = True
    kept_views = np.flatnonzero(used)
    views = np.full(brain.view.n, NO_TEMPLATE)
    views[kept_views] = np.arange(len(kept_views))
    gone = np.flatnonzero((root != np.arange(len(root))) & (templates != NO_TEMPLATE))[::-1]
    gone = gone[~used[templates[gone]]]
    # The first experience with a template says which view takes its place.
    views[templates[gone]] = views[templates[root[gone]]]
    return Renumbering(
        views=views,
        experiences=numbers[root],
        kept_views=kept_views,
        kept_experiences=kept,
        relative=relative_poses(poses[root], poses),
    )


def _comparison(brain: BrainState) -> Callable[[int, int], bool]:
    """Return the comparison of the views of two experiences.

    They are alike if their match error is at most the median of that with templates of all of the
    map.
    """
    view, templates = brain.view, brain.map.experiences.array("template")
    usual = np.unique(np.linspace(0, max(0, view.n - 1), min(view.n, _SAMPLE)).astype(np.int64))

    def alike(one: int, other: int) -> bool:
        first, second = int(templates[one]), int(templates[other])
        if first == second or NO_TEMPLATE in (first, second):
            return first == second
        stored = view.stored_view(first)
        error = view.differences(stored, np.array([second]))[0]
        return bool(error <= np.median(view.differences(stored, usual)))

    return alike
