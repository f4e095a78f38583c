"""A fleet of robots: one session per source, then a pairwise merge of the maps as a tree."""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import MapError, NeuroslamError, RunError, WriteError, counted
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.figures.sessions import Stage, plot_stages
from neuroslam.figures.style import SESSIONS, plain_text, save, shortened
from neuroslam.runs.files import OnBadFrame, RunPlan, brain_file, require_free, write_text
from neuroslam.runs.live_map import FoldThread, fold_folder, has_offers
from neuroslam.runs.merge import merge_runs
from neuroslam.runs.parallel import outcomes
from neuroslam.runs.reading import read_trace, trajectory, true_poses
from neuroslam.runs.sweep import claimed, figures, run_one
from neuroslam.sensors.open import absolute_spec

REPORT = "fleet.json"
MERGED = "merged"


@dataclass(frozen=True)
class Part:
    """A map of one session, or of several merged ones.

    Attributes:
        folder: Folder of its run, relative to the folder of the fleet.
        sessions: Numbers of its sessions, from 1, in order.
    """

    folder: str
    sessions: tuple[int, ...]

    def __str__(self) -> str:
        return "+".join(map(str, self.sessions))


@dataclass
class FleetReport:
    """Result of a fleet: the content of ``fleet.json``.

    Attributes:
        sessions: A row per source: figures of its run, or ``error``; and ``ate_merged_m``, its ATE
            (rigid) on the merged map, if the truth is known.
        tree: Each attempted merge: level, round, the two parts, and either folder or reason.
        merged: The largest map: its folder, sessions and figures; empty if nothing was merged.
        apart: Maps that are not part of it: folder, sessions and reasons.
    """

    sessions: list[dict[str, Any]] = field(default_factory=list)
    tree: list[dict[str, Any]] = field(default_factory=list)
    merged: dict[str, Any] = field(default_factory=dict)
    apart: list[dict[str, Any]] = field(default_factory=list)

    @property
    def failed(self) -> list[dict[str, Any]]:
        """Sessions that failed."""
        return [row for row in self.sessions if row["error"]]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return dict(vars(self))


@dataclass(frozen=True)
class _Session:
    # Arguments of one run: everything in it can be sent to another machine.
    source: str
    folder: Path
    config: BrainConfig
    preset: str
    on_bad_frame: OnBadFrame
    live: str | None = None
    robot: str = ""


@dataclass(frozen=True)
class _Pair:
    first: Path
    second: Path
    out: Path


def fleet(
    sources: Sequence[str | Path],
    out: str | Path,
    config: BrainConfig | None = None,
    *,
    preset: str = "",
    on_bad_frame: OnBadFrame = "stop",
    jobs: int | None = None,
    ray: str | None = None,
    live: str | Path | None = None,
    overwrite: bool = False,
    on_done: Callable[[str, int, int], None] | None = None,
) -> FleetReport:
    """Map each source, then merge the maps pairwise until one is left or no pair matches.

    On each level of the tree neighbours are paired first. Where two maps do not match, each is
    tried with the nearest other free map of the level; an unmerged map moves to the next level. The
    order depends on which maps merge, never on which run ends first.

    Args:
        sources: As for :func:`neuroslam.runs.run.run`, one session each.
        out: Folder to write: ``sessions/``, ``merges/``, ``merged/`` as :func:`merge_runs` writes
            it, ``fleet.json`` and ``fleet.png``. With Ray, on a disk shared by all machines.
        config: Config of all brains; default: the default config.
        preset: Name of the preset of the config, stored with the sessions.
        on_bad_frame: As for :func:`neuroslam.runs.run.run`.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.
        live: Folder of a new shared map to which all robots offer their places while they map; its
            fold is then the merged map, and robots in quarantine stay apart; see
            :mod:`neuroslam.runs.live_map`.
        overwrite: Replace an earlier fleet in ``out``.
        on_done: Called after each run and merge with the stage, the number done and the total.

    Returns:
        The tree, all merge reports, the maps that stay apart and the reasons. A session that fails
        does not stop the others.

    Raises:
        RunError: If there are fewer than two sources, or ``out`` holds a fleet already, or Ray
            cannot be reached.
        WriteError: If ``out``, or a run or merge in it, cannot be written.
    """
    out = Path(out).resolve()
    if len(sources) < 2:
        raise RunError(f"fleet: got {counted(len(sources), 'source')}; expected at least 2")
    with claimed(out, REPORT, overwrite) as (folder, inside):
        digits = len(str(len(sources)))
        if live is not None and has_offers(live):
            raise RunError(f"{live}: holds a shared map already; expected a new folder for --live")
        where = None if live is None else str(Path(live).resolve())
        orders = [
            _Session(
                absolute_spec(str(source)), inside / "sessions" / f"{number:0{digits}d}",
                config or BrainConfig(), preset, on_bad_frame, where, str(number),
            )
            for number, source in enumerate(sources, start=1)
        ]  # fmt: skip
        for order in orders:
            require_free(order.folder, order.source, overwrite)
        if inside == out:
            if not overwrite and any((out / name).exists() for name in ("merges", MERGED)):
                raise RunError(
                    f"{out}: holds merges of a fleet already; choose another folder or use "
                    "--overwrite"
                )
            for name in ("merges", MERGED):  # of a fleet that was cut off
                shutil.rmtree(out / name, ignore_errors=True)
        report = FleetReport()
        with nullcontext() if where is None else FoldThread(where):
            found = _collect(_map, orders, jobs, ray, "sessions", on_done)
        for number, (order, outcome) in enumerate(zip(orders, found, strict=True), start=1):
            row = {"session": number, "source": str(sources[number - 1])}
            name = str(order.folder.relative_to(inside))
            report.sessions.append(row | {"folder": name} | figures(outcome, order.folder))
        parts = [
            Part(row["folder"], (row["session"],)) for row in report.sessions if not row["error"]
        ]
        if where is None:
            parts = _merge_all(parts, inside, report, jobs, ray, on_done)
        else:
            parts = _folded(parts, where, inside, report)
        _conclude(parts, inside, folder.staged, report)
        folder.commit(() if inside == out else ("sessions", "merges", MERGED, "fleet.png"))
    return report


def _map(order: _Session) -> dict[str, Any]:
    arguments = {
        "preset": order.preset, "on_bad_frame": order.on_bad_frame,
        "live": order.live, "robot": order.robot,
    }  # fmt: skip
    return run_one(order.source, order.folder, order.config, **arguments)


def _merge(pair: _Pair) -> list[dict[str, Any]]:
    """Merge two maps; return the reports, that of the two first."""
    _, reports = merge_runs(pair.first, pair.second, pair.out, overwrite=True)
    return [report.to_dict() for report in reports]


def _collect(
    function: Callable[[Any], Any],
    orders: Sequence[Any],
    jobs: int | None,
    ray: str | None,
    what: str,
    on_done: Callable[[str, int, int], None] | None,
) -> list[Any]:
    found: dict[int, Any] = {}
    with closing(outcomes(function, orders, jobs, ray)) as each:
        for number, outcome in each:
            if isinstance(outcome, WriteError):  # a full disk fails all that follow
                raise outcome
            found[number] = outcome
            if on_done is not None:
                on_done(what, len(found), len(orders))
    return [found[number] for number in range(len(orders))]


def _folded(parts: list[Part], live: str, out: Path, report: FleetReport) -> list[Part]:
    """Fold the shared map of a fleet; return its part, and those of robots in quarantine."""
    done = fold_folder(live, out / "merges" / "live", overwrite=True)
    robots = [int(name) for name in done.fold["robots"]]
    by_number = {part.sessions[0]: part for part in parts}
    sessions = tuple(sorted(robots))
    for row in done.fold["quarantine"]:
        number = int(row["robot"])
        if number in by_number and number not in robots:
            report.tree.append(
                {"level": 1, "round": 1, "first": [number], "second": list(sessions),
                 "merged": False, "reason": row["reason"], "reports": []}
            )  # fmt: skip
    apart = [part for number, part in by_number.items() if number not in robots]
    return [Part("merges/live", sessions), *apart]


def _merge_all(
    parts: list[Part],
    out: Path,
    report: FleetReport,
    jobs: int | None,
    ray: str | None,
    on_done: Callable[[str, int, int], None] | None,
) -> list[Part]:
    """Merge until one map is left, or every pair of the remaining maps was refused."""
    tried: set[tuple[Part, Part]] = set()
    level, before = 0, 0
    while len(parts) > 1 and len(parts) != before:
        level, before, turn, made = level + 1, len(parts), 0, 0
        free, merged = list(parts), []
        while pairs := list(_pairs(free, tried)):
            turn += 1
            orders = [
                _Pair(out / a.folder, out / b.folder, out / "merges" / f"{level}-{made + k}")
                for k, (a, b) in enumerate(pairs, start=1)
            ]
            made += len(pairs)
            found = _collect(_merge, orders, jobs, ray, f"merges, level {level}", on_done)
            for pair, order, outcome in zip(pairs, orders, found, strict=True):
                row: dict[str, Any] = {
                    "level": level, "round": turn,
                    "first": list(pair[0].sessions), "second": list(pair[1].sessions),
                }  # fmt: skip
                if isinstance(outcome, NeuroslamError):
                    row |= {"merged": False, "reason": str(outcome), "reports": []}
                else:
                    row |= {"merged": outcome[0]["merged"], "reason": outcome[0]["reason"]}
                    row["reports"] = outcome
                tried.add(pair)
                if row["merged"]:
                    row["folder"] = str(order.out.relative_to(out))
                    both = tuple(sorted(pair[0].sessions + pair[1].sessions))
                    merged.append(Part(row["folder"], both))
                    free = [part for part in free if part not in pair]
                report.tree.append(row)
        parts = sorted([*merged, *free], key=lambda part: part.sessions)
    return parts


def _pairs(free: Sequence[Part], tried: set[tuple[Part, Part]]) -> Iterator[tuple[Part, Part]]:
    """Pair the parts that were not tried together yet, neighbours first; each part once."""
    left = dict.fromkeys(range(len(free)))
    for apart in range(1, len(free)):
        for k in range(len(free) - apart):
            pair = (free[k], free[k + apart])
            if k in left and k + apart in left and pair not in tried:
                del left[k], left[k + apart]
                yield pair


def _conclude(parts: list[Part], out: Path, to: Path, report: FleetReport) -> None:
    """Copy the largest map to ``merged``, measure it, list the maps apart, and draw.

    Args:
        parts: The maps that are left.
        out: Folder of the sessions and merges.
        to: Folder to write.
        report: The report, which is completed.
    """
    most = max(parts, key=lambda part: len(part.sessions), default=None)
    stages, made = [], set()
    if most is not None and len(most.sessions) > 1:
        shutil.copytree(out / most.folder, to / MERGED)
        brain = load_brain(brain_file(to / MERGED))
        report.merged = {
            "folder": MERGED,
            "made_in": most.folder,
            "sessions": list(most.sessions),
            "templates": brain.view.n,
            "experiences": brain.map.n,
            "links": brain.map.n_links,
        }
        _measure(brain, most, out, report)
    for part in parts:
        if part is not most or not report.merged:
            reasons = [
                f"with {'+'.join(map(str, other))}: {row['reason']}"
                for row in report.tree
                for own, other in (("first", "second"), ("second", "first"))
                if not row["merged"] and row[own] == list(part.sessions)
                for other in (row[other],)
            ]
            report.apart.append(
                {"sessions": list(part.sessions), "folder": part.folder, "reasons": reasons}
            )
        stage, makers = _stage(part, out, report)
        stages.append((part is most, stage))
        made |= makers
    text = json.dumps(report.to_dict(), indent=2, ensure_ascii=False) + "\n"
    if stages:
        stages.sort(key=lambda stage: not stage[0])
        title = f"A fleet of {len(report.sessions)}"
        if most is not None and report.merged:
            title += f": {len(most.sessions)} sessions on one map"
        title += f", {len(report.apart)} apart" if report.apart else ""
        title += f", {len(report.failed)} failed" if report.failed else ""
        if len(report.sessions) > len(SESSIONS):
            title += f"; colours repeat after {len(SESSIONS)} sessions"
        figure = plot_stages([stage for _, stage in stages], title, _names(report, made))
        save(figure, to / "fleet.png")
    write_text(to / REPORT, text)


def _names(report: FleetReport, made: set[int]) -> list[str]:
    """Name each session by its source, and mark those that created no drawn experience."""
    names = []
    for row in report.sessions:
        name = plain_text(f"{row['session']}: {shortened(RunPlan(row['source']).name)}")
        without = "failed" if row["error"] else "no experience of its own"
        names.append(name if row["session"] in made else f"{name}, {without}")
    return names


def _measure(brain: NavigationBrain, part: Part, out: Path, report: FleetReport) -> None:
    """Compute the ATE (rigid) of all sessions on one map, each and together."""
    tracks, truths = [], []
    for number in part.sessions:
        trace = read_trace(out / report.sessions[number - 1]["folder"])
        truth = true_poses(trace)
        if truth is None:
            return
        track = trajectory(brain, trace)
        on = np.isfinite(track[:, 0]) & np.isfinite(truth[:, 0])
        tracks.append(track[on, :2])
        truths.append(truth[on, :2])
    try:
        both = np.concatenate(tracks), np.concatenate(truths)
        report.merged["ate_rmse_m"] = absolute_trajectory_error(*both, "rigid").rmse
        for number, track, truth in zip(part.sessions, tracks, truths, strict=True):
            alone = absolute_trajectory_error(track, truth, "rigid")
            report.sessions[number - 1]["ate_merged_m"] = alone.rmse
    except MapError:  # robots that did not move: the alignment is undetermined
        return


def _stage(part: Part, out: Path, report: FleetReport) -> tuple[Stage, set[int]]:
    """Return a map as it is drawn, and the sessions that created its experiences."""
    brain = load_brain(brain_file(out / part.folder))
    ids = {  # a kidnapped robot, or a gap in a recording, makes several
        session.id: row["session"]
        for row in report.sessions
        if row["session"] in part.sessions
        for session in load_brain(brain_file(out / row["folder"])).sessions.sessions
    }
    links = brain.map.links
    makers = [ids[session] for session in brain.map.experiences["session"].tolist()]
    stage = Stage(
        f"{'session' if len(part.sessions) == 1 else 'sessions'} {part}",
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        (np.array(makers, dtype=np.int64) - 1) % len(SESSIONS),
    )
    return stage, set(makers)
