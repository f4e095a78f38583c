"""Merging of two finished sessions, given as runs or brain files, into a run folder."""

from dataclasses import replace
from pathlib import Path

import torch

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import RunError
from neuroslam.merging.match import find_match
from neuroslam.merging.report import MergeReport
from neuroslam.runs.files import FRAME_COLUMNS, RunPlan, brain_file, require_free
from neuroslam.runs.manifest import copy_saved
from neuroslam.runs.reading import read_plan
from neuroslam.runs.results import RunSaver, RunSummary, write_results
from neuroslam.runs.saves import final, writing
from neuroslam.threads import limit_threads, usable_threads

_REST_LOOPS = 5000
"""Most relaxation loops after a merge; a large map relaxes further when it is used."""


_ROWS = {"frames.csv": FRAME_COLUMNS + "\n", "trace.f64": ""}
"""The files of a run with one row per frame, and their content without frames."""


def join_brains(
    loaded: NavigationBrain, partial: NavigationBrain
) -> tuple[NavigationBrain | None, list[MergeReport]]:
    """Match and merge two finished maps, then the stored maps of either.

    Args:
        loaded: The brain that is merged into; it is not altered.
        partial: The brain whose session can be resumed afterwards; it is not altered.

    Returns:
        The merged brain, or ``None`` if the merge is refused; and a report of each merge, that of
        the two brains first.
    """
    found = find_match(loaded, partial)
    if found.match is None:
        return None, [_refusal(found.reason, loaded, partial)]
    merged, report = loaded.merge(partial, found.match)
    report.found = found.reason
    reports = [report]
    if merged is None:
        return None, reports
    merged.sessions.merges[-1] = report.to_dict()
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
    confirm: int | None = None,
    overwrite: bool = False,
) -> tuple[RunSummary | None, list[MergeReport]]:
    """Merge two finished sessions and write the files of a run; nothing if the merge is refused.

    The folder holds the second session on the merged map: its frames are copied, and ``resume``
    continues it. If the second is only a brain file, there are no frames to write.

    Args:
        first: Run folder or brain file that is merged into; its ids stay.
        second: Run folder or brain file of the session that can be resumed.
        out: Folder to write; made if missing.
        confirm: Experiences that must agree; default: the config of the second.
        overwrite: Replace the files of an earlier run in ``out``.

    Returns:
        The content of ``metrics.json``, or ``None`` if the merge is refused; and the reports.

    Raises:
        CheckpointError: If a brain cannot be loaded.
        RunError: If ``out`` is one of the two or holds a run already, or cannot be written.
    """
    out, files = Path(out), [brain_file(path) for path in (first, second)]
    brains = [load_brain(file) for file in files]
    for file in files:
        require_free(out, str(file.resolve()), overwrite)
        if file.resolve().parent == out.resolve():
            raise RunError(f"{out}: holds one of the two maps; choose another folder")
    for name in _ROWS:
        if Path(second).is_dir() and not (Path(second) / name).is_file():
            raise RunError(
                f"{Path(second) / name}: missing; to merge the map without its frames, give "
                f"{files[1]}"
            )
    loaded, partial = brains
    if confirm is not None:
        sessions = partial.config.sessions.model_copy(update={"confirm": confirm})
        partial.config = partial.config.model_copy(update={"sessions": sessions})
    with limit_threads(usable_threads(partial.config.threads)), torch.inference_mode():
        merged, reports = join_brains(loaded, partial)
        if merged is None:
            return None, reports
        plan = replace(_plan_of(second), maps=(str(final(files[0].resolve())),))
        return _write(merged, plan, Path(second), files, out, overwrite), reports


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
