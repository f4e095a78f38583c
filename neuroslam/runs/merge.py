"""Merging of finished sessions, given as runs or brain files, into a run folder."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import torch

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import ConfigError, RunError
from neuroslam.merging.match import Found, find_match
from neuroslam.merging.report import MergeReport
from neuroslam.runs.files import FRAME_COLUMNS, RunPlan, brain_file, require_free
from neuroslam.runs.manifest import copy_saved
from neuroslam.runs.reading import read_plan
from neuroslam.runs.results import RunSaver, RunSummary, write_results
from neuroslam.runs.run import resolve_config
from neuroslam.runs.saves import final, writing
from neuroslam.threads import limit_threads, usable_threads

_REST_LOOPS = 5000
"""Most relaxation loops after a merge; a large map relaxes further when it is used."""


_ROWS = {"frames.csv": FRAME_COLUMNS + "\n", "trace.f64": ""}
"""The files of a run with one row per frame, and their content without frames."""


def join_brains(*brains: NavigationBrain) -> tuple[NavigationBrain | None, list[MergeReport]]:
    """Match and merge finished maps, then the stored maps of any.

    Of a drive with several maps the largest is matched, ``NavigationBrain.largest``. All pairs
    are matched; of those that meet, the one with most matched experiences is merged first, then
    the pairs with the merged map are matched again. If the last drive ended on another map than
    its largest one, that map joins the merged one, or stays the present one beside it.

    Args:
        *brains: At least two; the ids of the first stay, the session of the last can be resumed
            afterwards. None is altered.

    Returns:
        The merged brain, or ``None`` if a map meets no other; and a report of each merge of
        ``brains``, then of the stored maps, or of each refusal.
    """
    pool, reports = dict(enumerate(map(_largest_first, brains))), list[MergeReport]()
    last = brains[-1]
    if pool[len(brains) - 1] is not last:  # its present map, with which the session goes on
        pool[len(brains) - 1] = _largest_first(last, keep_present=False)
    found: dict[tuple[int, int], Found] = {}
    while len(pool) > 1:
        for i, j in combinations(sorted(pool), 2):
            if (i, j) not in found:
                found[i, j] = find_match(pool[i], pool[j])
        refusals: list[MergeReport] = []
        for i, j in sorted(found, key=lambda pair: -_n_matched(found[pair])):
            merged, report = _merge_found(pool[i], pool[j], found[i, j])
            if merged is not None:
                break
            refusals.append(report)
        else:
            return None, refusals
        reports.append(report)
        pool[j] = merged
        del pool[i]
        found = {pair: of for pair, of in found.items() if not {i, j} & {*pair}}
    (merged,) = pool.values()
    merged, reports = _join_stored(merged, reports)
    return (merged if last.largest is last else _go_on(last, merged, reports)), reports


def _largest_first(brain: NavigationBrain, keep_present: bool = True) -> NavigationBrain:
    """Return a brain whose present map is the largest of its drive; the others are stored."""
    largest = brain.largest
    if largest is brain:
        return brain
    others = [one for one in brain.stored if one is not largest]
    return _alone(largest, [*others, _alone(brain)] if keep_present else others)


def _alone(brain: NavigationBrain, stored: Sequence[NavigationBrain] = ()) -> NavigationBrain:
    """Return a copy of a brain with other stored maps."""
    own = {name: v for name, v in brain.state_dict().items() if not name.startswith("stored.")}
    copied = NavigationBrain(brain.config)
    copied.restore(own, stored)
    return copied


def _go_on(
    last: NavigationBrain, merged: NavigationBrain, reports: list[MergeReport]
) -> NavigationBrain:
    """Return the last drive on its present map: part of the merged map, or beside it."""
    others, present = list(merged.stored), _alone(last)
    found = find_match(merged, present)
    if found.match is not None:
        joined, report = _alone(merged).merge(present, found.match)
        if joined is not None:
            reports.append(report)
            return _alone(joined, others)
    return _alone(last, [_alone(merged), *others])


def _merge_found(
    loaded: NavigationBrain, partial: NavigationBrain, found: Found
) -> tuple[NavigationBrain | None, MergeReport]:
    if found.match is None:
        return None, _refusal(found.reason, loaded, partial)
    merged, report = loaded.merge(partial, found.match)
    report.found = found.reason
    if merged is not None:
        merged.sessions.merges[-1] = report.to_dict()
    return merged, report


def _n_matched(found: Found) -> int:
    return 0 if found.match is None else len(found.match.pairs.partial)


def _join_stored(
    merged: NavigationBrain, reports: list[MergeReport]
) -> tuple[NavigationBrain, list[MergeReport]]:
    """Merge the stored maps that are recognised, and relax the result."""
    left = list(merged.stored)
    while left:
        more = _join_one(merged, left)
        if more is None:
            break
        merged, report = more
        left = list(merged.stored)
        reports.append(report)
    merged.map.state.at_rest = 0
    merged.map.relax(max(20, min(_REST_LOOPS, 5_000_000 // max(1, merged.map.n_links))))
    return merged, reports


def _join_one(
    brain: NavigationBrain, stored: list[NavigationBrain]
) -> tuple[NavigationBrain, MergeReport] | None:
    for i, other in enumerate(stored):
        found = find_match(other, brain)
        if found.match is None:
            continue
        alone = NavigationBrain(brain.config)
        alone.restore(brain.state_dict(), stored[:i] + stored[i + 1 :])
        merged, report = other.merge(alone, found.match)
        if merged is not None:
            return merged, report
    return None


def _refusal(reason: str, loaded: NavigationBrain, partial: NavigationBrain) -> MergeReport:
    return MergeReport(
        merged=False,
        reason=reason,
        loaded_sessions=[session.name for session in loaded.sessions.sessions],
        partial_sessions=[session.name for session in partial.sessions.sessions],
        counts={
            "views": {"loaded": loaded.view.n, "partial": partial.view.n},
            "experiences": {"loaded": loaded.map.n, "partial": partial.map.n},
            "links": {"loaded": loaded.map.n_links, "partial": partial.map.n_links},
        },
    )


def merge_runs(
    first: str | Path,
    second: str | Path,
    out: str | Path,
    *,
    between: Sequence[str | Path] = (),
    confirm: int | None = None,
    assignments: Sequence[str] = (),
    overwrite: bool = False,
) -> tuple[RunSummary | None, list[MergeReport]]:
    """Merge finished sessions and write the files of a run; nothing if a merge is refused.

    The folder holds the last session on the merged map: its frames are copied, and ``resume``
    continues it. If the last is only a brain file, there are no frames to write.

    Args:
        first: Run folder or brain file that is merged into; its ids stay.
        second: Run folder or brain file of the session that can be resumed.
        out: Folder to write; made if missing.
        between: Further run folders or brain files; all maps must become one.
        confirm: Experiences that must agree; default: the config of the second.
        assignments: Assignments like ``sessions.drift=0.4``, for all maps.
        overwrite: Replace the files of an earlier run in ``out``.

    Returns:
        The content of ``metrics.json``, or ``None`` if the merge is refused; and the reports.

    Raises:
        CheckpointError: If a brain cannot be loaded.
        ConfigError: If an assignment is invalid, or changes what the maps are made of.
        RunError: If ``out`` is one of the maps or holds a run already, or cannot be written.
    """
    out, files = Path(out), [brain_file(path) for path in (first, *between, second)]
    brains = [load_brain(file) for file in files]
    for file in files:
        require_free(out, str(file.resolve()), overwrite)
        if file.resolve().parent == out.resolve():
            raise RunError(f"{out}: holds one of the maps; choose another folder")
    for name in _ROWS:
        if Path(second).is_dir() and not (Path(second) / name).is_file():
            raise RunError(
                f"{Path(second) / name}: missing; to merge the map without its frames, give "
                f"{files[-1]}"
            )
    if confirm is not None:
        assignments = [*assignments, f"sessions.confirm={confirm}"]
    brains = [_reconfigured(brain, assignments) for brain in brains]
    with limit_threads(usable_threads(brains[-1].config.threads)), torch.inference_mode():
        merged, reports = join_brains(*brains)
        if merged is None:
            return None, reports
        maps = tuple(str(final(file.resolve())) for file in files[:-1])
        plan = replace(_plan_of(second), maps=maps)
        return _write(merged, plan, Path(second), files, out, overwrite), reports


def _reconfigured(brain: NavigationBrain, assignments: Sequence[str]) -> NavigationBrain:
    """Return a brain with some parameters of matching and of the map set; itself if none is.

    Raises:
        ConfigError: If an assignment is invalid, or changes what the map is made of.
    """
    if not assignments:
        return brain
    for text in assignments:
        key = text.partition("=")[0].strip()
        if key != "view.threshold" and key.partition(".")[0] not in ("sessions", "map"):
            raise ConfigError(
                f"--set {text}: the maps are made with {key}; a merge can change sessions.*, "
                "map.* and view.threshold"
            )
    config = resolve_config(assignments=tuple(assignments), base=brain.config)
    changed = NavigationBrain(config)
    stored = [_reconfigured(one, assignments) for one in brain.stored]
    changed.restore(brain.state_dict(), stored)
    return changed


def _plan_of(second: str | Path) -> RunPlan:
    path = Path(second)
    return read_plan(path) if path.is_dir() else RunPlan(str(path.resolve()))


def _write(
    brain: NavigationBrain, plan: RunPlan, second: Path, sources: list[Path], out: Path, over: bool
) -> RunSummary:
    """Write a run whose rows are those of the second; an earlier run is kept until all is there."""
    with writing(out) as folder:
        for source in sources:
            require_free(out, str(source.resolve()), over)  # another process may have been faster
        for file, empty in _ROWS.items():
            if second.is_dir():
                copy_saved(second / file, folder.staged / file)
            else:
                (folder.staged / file).write_text(empty)
        return write_results(brain, plan, RunSaver(folder, folder.staged), RunSummary())
