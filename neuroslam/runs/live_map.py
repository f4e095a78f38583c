"""Runs of robots on a shared map: each offers while it maps; the fold becomes a run folder."""

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import RunError, SharedMapError, counted
from neuroslam.runs.files import FRAME_COLUMNS, RunPlan, brain_file, require_free, write_text
from neuroslam.runs.recording import Recorder
from neuroslam.runs.results import RunSaver, RunSummary, write_results
from neuroslam.runs.saves import writing
from neuroslam.shared_map.fold import Folded, fold, publication
from neuroslam.shared_map.journal import FILE, Entry, Journal, Offers
from neuroslam.shared_map.messages import decode
from neuroslam.shared_map.on_ray import PREFIX, RayJournal
from neuroslam.shared_map.records import Records
from neuroslam.shared_map.robot import LiveRobot

if TYPE_CHECKING:
    from neuroslam.config import BrainConfig
    from neuroslam.types import Frame, StepResult

REPORT = "shared_map.json"

EVERY_S = 0.5
"""Wall-clock seconds between two offers of a robot."""

RETRY_S = 5.0
"""Seconds until a robot that could not reach the journal tries again."""


def open_journal(where: str | Path, config: "BrainConfig | None" = None) -> Offers:
    """Open the journal of a shared map: in a folder, or ``ray:NAME`` of a Ray cluster.

    Raises:
        ConfigError: If its robots have another config.
        SharedMapError: If it cannot be opened.
    """
    text = str(where)
    if text.startswith(PREFIX):
        return RayJournal(text.removeprefix(PREFIX), config)
    return Journal(where, config)


def config_of(where: str | Path) -> "BrainConfig | None":
    """Return the config of the robots of a shared map; ``None`` if none has offered yet.

    Raises:
        SharedMapError: If the journal is damaged or cannot be reached.
    """
    if str(where).startswith(PREFIX):
        return RayJournal(str(where).removeprefix(PREFIX)).config
    if not (Path(where) / FILE).is_file():
        return None
    with Journal(where) as journal:
        return journal.config


def has_offers(where: str | Path) -> bool:
    """Return whether a folder holds a shared map already."""
    return (Path(where) / FILE).exists()


class LiveRecorder(Recorder):
    """Offers what a run adds to its map; a journal that cannot be reached never stops the run.

    Args:
        where: Folder of the shared map, or ``ray:NAME``.
        brain: The brain of the run.
        name: Name of the robot; default: its session.
        every_s: Wall-clock seconds between two offers.

    Raises:
        ConfigError: If the robots of the shared map have another config.
        SharedMapError: If the journal cannot be opened.
    """

    def __init__(
        self, where: str | Path, brain: NavigationBrain, name: str = "", every_s: float = EVERY_S
    ) -> None:
        self.where = str(where)
        self.journal = open_journal(where, brain.config)
        self.robot = LiveRobot(self.journal, brain, name)
        self.every_s = every_s
        self.failure = ""
        self._due = 0.0

    def step(self, result: "StepResult", frame: "Frame", brain: NavigationBrain) -> None:
        """Offer what is new, if it is time."""
        if time.monotonic() >= self._due:
            self._offer()

    def _offer(self) -> None:
        try:
            self.robot.offer()
        except SharedMapError as error:
            self.failure, wait_s = str(error), RETRY_S
        else:
            self.failure, wait_s = "", self.every_s
        self._due = time.monotonic() + wait_s

    def close(self) -> None:
        """Offer the rest."""
        self._offer()
        if isinstance(self.journal, Journal):
            self.journal.close()

    def note(self) -> str:
        """Write what was offered, and what was not."""
        robot = self.robot
        line = f"shared map {self.where}: {robot.n_offered} places offered as {robot.name!r}"
        line += f", {robot.sent_bytes / 1e6:.2f} MB"
        if self.failure:
            line += f"; the rest was not ({self.failure}); neuroslam live DIR RUN offers it"
        return line


def offer_runs(where: str | Path, runs: Sequence[str | Path]) -> list[dict[str, Any]]:
    """Offer the maps of finished runs, of robots that were out of reach; known places are skipped.

    Args:
        where: Folder of the shared map; made with the config of the first run if missing.
        runs: Run folders or brain files.

    Returns:
        For each run its robot, the number of its places that are new, and the bytes sent.

    Raises:
        CheckpointError: If a brain cannot be loaded.
        ConfigError: If its config is not that of the shared map.
        SharedMapError: If the journal refuses it.
    """
    rows = []
    for run in runs:
        brain = load_brain(brain_file(run))
        with Journal(where, brain.config) as journal:
            robot = LiveRobot(journal, brain)
            robot.take()
            before = robot.n_offered
            robot.offer()
            rows.append(
                {"run": str(run), "robot": robot.name, "places": robot.n_offered - before,
                 "bytes": robot.sent_bytes}
            )  # fmt: skip
    return rows


class Folder:
    """Folds a journal again when there are new offers, and publishes each fold.

    Args:
        journal: The journal; its config is that of the fold.
    """

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self.records, self.upto = Records(), 0
        self.entries = self.n_bytes = 0
        self.folded: Folded | None = None
        self.seconds = 0.0

    def update(self) -> bool:
        """Fold if there are new offers; return whether there were."""
        new = False
        while entries := self.journal.since(self.upto):
            for entry in entries:
                self._add(entry)
            self.upto, new = entries[-1].number, True
        if new or self.folded is None:
            began = time.perf_counter()
            self.folded = fold(self.records, self.journal.config)
            self.seconds = time.perf_counter() - began
            self.journal.publish(publication(self.folded, self.upto))
        return new

    def _add(self, entry: Entry) -> None:
        self.records.add(entry.robot, decode(entry.message))
        self.entries += 1
        self.n_bytes += len(entry.message)


class FoldThread(threading.Thread):
    """Folds a journal in the background while robots map, until it is stopped.

    Args:
        folder: Folder of the shared map.
        pause_s: Pause between two folds; at least as long as the last fold took.
    """

    def __init__(self, folder: str | Path, pause_s: float = 1.0) -> None:
        super().__init__(daemon=True)
        self.folder, self.pause_s = folder, pause_s
        self.failure = ""
        self._ended = threading.Event()

    def run(self) -> None:
        """Fold until stopped; without a journal wait for one."""
        at_work: Folder | None = None
        while not self._ended.wait(max(self.pause_s, at_work.seconds if at_work else 0.0)):
            try:
                at_work = at_work or Folder(Journal(self.folder))
                at_work.update()
                self.failure = ""
            except SharedMapError as error:  # no robot has offered yet, or the disk is full
                self.failure = str(error)

    def stop(self) -> None:
        """End after the fold in progress."""
        self._ended.set()
        self.join()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.stop()


@dataclass
class LiveReport:
    """Result of folding a journal: the content of ``shared_map.json``.

    Attributes:
        offers: Offers in the journal, and their bytes.
        seconds: Duration of the fold.
        fold: Digest, size, robots, and what is in quarantine with the reasons.
        robots: For each robot its offered places.
    """

    offers: dict[str, int]
    seconds: float
    fold: dict[str, Any]
    robots: dict[str, int] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return dict(vars(self))

    def lines(self) -> list[str]:
        """Return the report as text, one fact per line."""
        f = self.fold
        lines = [
            f"{counted(self.offers['n'], 'offer')} of {counted(len(self.robots), 'robot')}, "
            f"{self.offers['bytes'] / 1e6:.2f} MB: {counted(sum(self.robots.values()), 'place')}",
            f"shared map: {counted(f['places'], 'experience')}, {counted(f['links'], 'link')} of "
            f"{', '.join(f['robots']) or 'no robot'}",
        ]
        lines += [
            f"in quarantine: {row['robot']}, {counted(row['places'], 'place')}: {row['reason']}"
            for row in f["quarantine"]
        ]
        return lines


def fold_folder(
    where: str | Path,
    out: str | Path | None = None,
    *,
    overwrite: bool = False,
    on_fold: Callable[[LiveReport], None] | None = None,
    watch_s: float | None = None,
) -> LiveReport:
    """Fold the journal of a shared map, publish the fold, and write it as a run folder.

    Args:
        where: Folder of the shared map.
        out: Folder to write, as of a run without frames, with ``shared_map.json``; ``None``: none.
        overwrite: Replace an earlier one.
        on_fold: Called after each fold.
        watch_s: Fold again as often as there are new offers, with such pauses, until Ctrl-C.

    Raises:
        RunError: If ``out`` cannot be written, or no place was offered.
        SharedMapError: If the journal is missing or damaged.
    """
    if out is not None:
        require_free(Path(out), str(Path(where).resolve()), overwrite)
    with Journal(where) as journal:
        work = Folder(journal)
        try:
            while True:
                if work.update() and on_fold is not None and watch_s is not None:
                    on_fold(_report(work))
                if watch_s is None:
                    break
                time.sleep(max(watch_s, work.seconds))
        except KeyboardInterrupt:
            if work.folded is None:
                raise
        report = _report(work)
        assert work.folded is not None  # update folds at least once
        if out is not None:
            _write(work.folded, report, journal.folder, Path(out), overwrite)
    return report


def _report(work: Folder) -> LiveReport:
    assert work.folded is not None
    robots: dict[str, int] = {}
    for session, _ in sorted(work.records.places):
        name = work.records.robots[session]
        robots[name] = robots.get(name, 0) + 1
    offers = {"n": work.entries, "bytes": work.n_bytes}
    return LiveReport(offers, work.seconds, work.folded.to_dict(), dict(sorted(robots.items())))


def _write(folded: Folded, report: LiveReport, where: Path, out: Path, over: bool) -> None:
    if folded.brain is None:
        raise RunError(f"{where}: no places to write; let a robot offer some first")
    plan = RunPlan(str(where.resolve()))
    with torch.inference_mode(), writing(out) as folder:
        require_free(out, plan.source, over)
        write_text(folder.staged / "frames.csv", FRAME_COLUMNS + "\n")
        (folder.staged / "trace.f64").write_bytes(b"")
        write_text(folder.staged / REPORT, json.dumps(report.to_dict(), indent=2) + "\n")
        write_results(folded.brain, plan, RunSaver(folder, folder.staged), RunSummary())
