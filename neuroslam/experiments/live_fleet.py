"""One live map for a fleet: four robots map the rendered town in a quarter of the time of one.

Settings were fixed on the town with ``look=0``; the rows of ``look=1`` and ``look=2``, other houses
and other noise of the odometry, were measured once with them.
"""

import random
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig, build_config
from neuroslam.evaluation.trajectory import absolute_trajectory_error, align
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.live_robots import hundred_robots, killed_robots, seconds_until_usable
from neuroslam.experiments.session_runs import SessionRecorder, SessionRun, track
from neuroslam.figures.style import (
    INK,
    SESSIONS,
    STYLE,
    WALL,
    legend_below,
    new_figure,
    save,
    write_title,
)
from neuroslam.sensors import open_source
from neuroslam.shared_map.fold import Folded, fold, gather
from neuroslam.shared_map.journal import Entry, Receipt
from neuroslam.shared_map.robot import LiveRobot
from neuroslam.state.files import tensors_digest
from neuroslam.types import Frame, Velocity
from neuroslam.worlds.world import WorldSource

TOUR = "world:town?route=6&noise=0.02"
"""Every street of the town: 1302 m, of which each block is driven around twice, then all of it."""

CONFIG: dict[str, Any] = {"view": {"threshold": 0.035}, "pose_cells": {"cell_size_m": 1.0}}

RATE_HZ = 10.0
EVERY = 10  # frames between two offers: a second
NEAR_M = 2.0
"""Distance of a place within which the tour counts as covered."""

FAULTS: dict[str, tuple[float, float, float]] = {
    "speed x 1.5": (1.5, 1.0, 0.0),
    "speed x 1.2": (1.2, 1.0, 0.0),
    "speed x 0.7": (0.7, 1.0, 0.0),
    "turns x 1.4": (1.0, 1.4, 0.0),
    "turns x 0.8": (1.0, 0.8, 0.0),
    "left and right swapped": (1.0, -1.0, 0.0),
    "turn rate + 0.03 rad/s": (1.0, 1.0, 0.03),
}
"""Fault of the odometry -> factor of the speed, factor of the turn rate, bias in rad/s."""


class Drive(NamedTuple):
    """A robot that has mapped by itself: its run, its offers, and when and where each place was.

    Attributes:
        run: Brain and trace.
        entries: Offers in order, as a journal has them; received at the time of the robot.
        made: Time (s) and true position (m) of each place, ``(places, 3)``.
    """

    run: SessionRun
    entries: list[Entry]
    made: np.ndarray


class _Offered:
    """A journal in memory: what a robot offers, with the robot's own time."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []
        self.now_s = 0.0

    def offer(self, robot: str, message: bytes) -> Receipt:
        """Keep an offer."""
        self.entries.append(Entry(len(self.entries) + 1, robot, self.now_s, message))
        return Receipt(len(self.entries), "", known=False)

    def since(self, number: int, most: int = 1000) -> list[Entry]:
        """Return offers after a number."""
        return self.entries[number : number + most]

    def published(self) -> None:
        """Return no fold: there is none while the robots drive."""


class Driver:
    """A robot that maps by itself, frame by frame, and offers what is new every second.

    Args:
        config: Of its brain.
        name: Its name.
    """

    def __init__(self, config: BrainConfig, name: str) -> None:
        self.session = SessionRecorder(config, name=name)
        self.kept = _Offered()
        self.robot = LiveRobot(self.kept, self.session.brain, name)
        self.made: list[tuple[float, ...]] = []

    def step(self, frame: Frame) -> None:
        """Advance by a frame; offer, if it is time."""
        assert frame.truth is not None
        self.session.step(frame)
        new = self.session.brain.map.n - len(self.made)
        self.made += [(frame.time_s, *frame.truth[:2])] * new
        if frame.index % EVERY == EVERY - 1:
            self.kept.now_s = frame.time_s
            self.robot.offer()

    def end(self) -> Drive:
        """Offer the rest, and return the drive."""
        self.robot.offer()
        return Drive(self.session.result(), self.kept.entries, np.array(self.made))


def drive(frames: Iterable[Frame], config: BrainConfig, name: str) -> Drive:
    """Let a robot map by itself, and offer what is new every second."""
    robot = Driver(config, name)
    for frame in frames:
        robot.step(frame)
    return robot.end()


class Part(NamedTuple):
    """A robot on a part of the tour: its driver, its frames, its odometry, and a fault of it."""

    driver: Driver
    first: int
    velocities: np.ndarray
    fault: tuple[float, float, float] = (1.0, 1.0, 0.0)

    def step(self, frame: Frame) -> None:
        """Advance by a frame of the tour, if it is one of this part."""
        k = frame.index - self.first
        if 0 <= k < len(self.velocities):
            own = frame._replace(
                index=k, time_s=k / RATE_HZ, velocity=Velocity(*self.velocities[k].tolist())
            )
            for moved in spoilt([own], self.fault):
                self.driver.step(moved)


def part_of_tour(
    start: float, seed: int, look: int, config: BrainConfig, name: str, fault: str = ""
) -> Part:
    """Return a robot that drives a quarter of the tour, with noise of its own.

    Args:
        start: Share of the tour at which it begins.
        seed: Of the noise of its odometry.
        look: Of the town.
        config: Of its brain.
        name: Its name.
        fault: One of :data:`FAULTS`; empty: none.
    """
    source = open_source(f"{TOUR}&laps=0.25&start={start}&seed={seed}&look={look}")
    assert isinstance(source, WorldSource)
    first = round(start * source.frames_per_lap)
    wrong = FAULTS[fault] if fault else (1.0, 1.0, 0.0)
    return Part(Driver(config, name), first, source.odometry(), wrong)


def spoilt(frames: Iterable[Frame], fault: tuple[float, float, float]) -> Iterator[Frame]:
    """Yield frames with a fault of the odometry, see :data:`FAULTS`."""
    for frame in frames:
        assert frame.velocity is not None
        v, w = frame.velocity
        moved = frame.velocity._replace(v_m_s=v * fault[0], w_rad_s=w * fault[1] + fault[2])
        yield frame._replace(velocity=moved)


def coverage(made: np.ndarray, tour: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Return the share of the tour within :data:`NEAR_M` of a place made until each time.

    Args:
        made: Time and true position of each place, ``(places, 3)``.
        tour: Positions along the tour, ``(m, 2)``.
        times_s: Times.

    Example:
        >>> made = np.array([[0.0, 0.0, 0.0], [5.0, 10.0, 0.0]])
        >>> tour = np.array([[0.0, 1.0], [10.0, 1.0]])
        >>> coverage(made, tour, np.array([1.0, 6.0])).tolist()
        [0.5, 1.0]
    """
    first = np.full(len(tour), np.inf)
    for at_s, x, y in made:
        near = np.hypot(tour[:, 0] - x, tour[:, 1] - y) <= NEAR_M
        first[near] = np.minimum(first[near], at_s)
    return np.array([float((first <= t).mean()) for t in times_s])


def _ate(brain: NavigationBrain, runs: Sequence[SessionRun]) -> tuple[float, np.ndarray]:
    """Return the ATE (rigid) of runs on a map, and the poses of the map in the frame of truth."""
    found, truth = track(brain, list(runs))
    on = np.isfinite(found[:, 0]) & np.isfinite(truth[:, 0])
    error = absolute_trajectory_error(found[on], truth[on], "rigid").rmse
    return error, align(found[on], truth[on], "rigid").apply(brain.map.poses[:, :2])


class Town(NamedTuple):
    """One robot and four in one town, and what they made of it."""

    rows: list[dict[str, Any]]
    drives: list[Drive]
    folded: Folded
    maps: list[np.ndarray]  # experiences in the frame of the truth: one robot's, then the fleet's
    covered: list[tuple[np.ndarray, np.ndarray]]  # times and coverage, likewise
    tour: np.ndarray
    wrong: list[Drive]


def town(look: int, config: BrainConfig, *, faults: bool) -> Town:
    """Map a town with one robot and with four; see the module.

    Args:
        look: Of the town.
        config: Of the brains.
        faults: Let robots with faults drive too.
    """
    whole = open_source(f"{TOUR}&laps=1&seed={100 * look + 4}&look={look}")
    assert isinstance(whole, WorldSource)
    tour = whole.truths()[:, :2]
    alone = Driver(config, "alone")
    quarters = [
        part_of_tour(k / 4, 100 * look + k, look, config, f"robot {k + 1}") for k in range(4)
    ]
    spoiling = [
        part_of_tour(0.1, 100 * look + 9, look, config, name, name) for name in FAULTS if faults
    ]
    for frame in whole.frames():  # each picture is rendered once, for all who pass there
        alone.step(frame)
        for part in (*quarters, *spoiling):
            part.step(frame)
    one, four = alone.end(), [part.driver.end() for part in quarters]
    entries = [entry for each in four for entry in each.entries]
    folded = fold(gather(entries), config)
    rows, maps, covered = [], [], []
    sets = (("one robot", [one], one.run.brain), ("four robots", four, folded.brain))
    for name, drives, brain in sets:
        made = np.concatenate([each.made for each in drives])
        times_s = np.arange(0.0, made[:, 0].max() + 1.0)
        share = coverage(made, tour, times_s)
        runs = [each.run for each in drives]
        assert brain is not None
        error, xy = _ate(brain, runs)
        n_bytes = sum(len(entry.message) for each in drives for entry in each.entries)
        enough = np.flatnonzero(share >= 0.95)
        rows.append(
            {
                "town": look,
                "robots": name,
                "drive_s": max(len(run.trace["session"]) for run in runs) / RATE_HZ,
                "time_to_95_percent_s": float(times_s[enough[0]]) if len(enough) else float("nan"),
                "coverage": float(share[-1]),
                "ate_rigid_m": error,
                "places_offered": len(made),
                "experiences": brain.map.n,
                "MB_per_1000_places": n_bytes / len(made) / 1e3,
            }
        )
        maps.append(xy)
        covered.append((times_s, share))
    wrong = [part.driver.end() for part in spoiling]
    return Town(rows, [one, *four], folded, maps, covered, tour, wrong)


def faults_row(of: Town, config: BrainConfig, look: int) -> list[dict[str, Any]]:
    """Add robots with faults and a stranger to a fleet; return whether each is kept out."""
    right = [entry for each in of.drives[1:] for entry in each.entries]
    wrong = [entry for each in of.wrong for entry in each.entries]
    elsewhere = open_source(f"{TOUR}&laps=0.25&seed={100 * look + 8}&look={look + 50}")
    wrong += drive(elsewhere.frames(), config, "a stranger's map").entries
    folded = fold(gather([*wrong, *right]), config)
    reasons = {row["robot"]: row["reason"] for row in folded.quarantine}
    same = np.array_equal(folded.layout, of.folded.layout)
    return [
        {
            "fault": name,
            "in_quarantine": name in reasons,
            "map_unchanged": same,
            "reason": reasons.get(name, ""),
        }
        for name in (*FAULTS, "a stranger's map")
    ]


def order_rows(of: Town, config: BrainConfig) -> list[dict[str, Any]]:
    """Fold the offers of a fleet in another order, some of them twice."""
    entries = [entry for each in of.drives[1:] for entry in each.entries]
    shuffled = [*entries, *entries[::4]]
    random.Random(5).shuffle(shuffled)
    again = fold(gather(shuffled), config)
    assert again.brain is not None
    assert of.folded.brain is not None
    digests = [tensors_digest(brain.state_dict()) for brain in (again.brain, of.folded.brain)]
    return [{"offers_shuffled": len(shuffled), "maps_are_equal": digests[0] == digests[1]}]


def live_fleet(
    _data_folder: Path | None,
    out: Path,
    *,
    looks: Sequence[int] = (0, 2, 1),
    processes: bool = True,
) -> dict[str, Any]:
    """Compare one robot with four, spoil the fleet, kill it, and measure how fast it is.

    Args:
        _data_folder: Unused.
        out: Folder to write: ``results.json`` and ``live_fleet.png``.
        looks: Towns; the faults and the figure are of the last.
        processes: Also run the parts with processes: kills, time until usable, a hundred robots.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    config = build_config(CONFIG, "live-fleet")
    rows: list[dict[str, Any]] = []
    took = np.zeros(0)
    measured: dict[str, Any] = {}
    if processes:  # first: before this process has threads
        measured = killed_robots(out) | hundred_robots(out)
        took = seconds_until_usable(out)
        if len(took):
            measured |= {
                "places_timed": len(took),
                "usable_after_median_s": float(np.median(took)),
                "usable_after_largest_s": float(took.max()),
            }
    with torch.inference_mode():
        towns = [town(look, config, faults=look == looks[-1]) for look in looks]
        for one in towns:
            rows += one.rows
        last = towns[-1]
        spoilt_rows = faults_row(last, config, looks[-1])
        ordered = order_rows(last, config)
    save(plot_fleet(last, took), out / "live_fleet.png")
    results = {
        "experiment": "live-fleet",
        "rows": rows,
        "faults": spoilt_rows,
        "order": ordered,
        "processes": measured,
        "took_s": took.round(3).tolist(),
    }
    more = [{"town": "", "robots": name, "value": value} for name, value in measured.items()]
    more += [
        {"town": looks[-1], "robots": f"fault: {row['fault']}", "value":
         "in quarantine" if row["in_quarantine"] and row["map_unchanged"] else "TAKEN"}
        for row in spoilt_rows
    ]  # fmt: skip
    more += [
        {"town": looks[-1], "robots": "other order of arrival",
         "value": "equal map" if row["maps_are_equal"] else "ANOTHER MAP"}
        for row in ordered
    ]  # fmt: skip
    write_results(out, results)
    return results | {"rows": [*rows, *more]}


def plot_fleet(of: Town, took: np.ndarray) -> Figure:
    """Draw the maps of one robot and of four, the coverage over time, and the time until usable.

    Args:
        of: The town.
        took: Seconds until each place was usable by another; empty: not measured.
    """
    brain = of.folded.brain
    assert brain is not None
    sessions = [each.run.brain.sessions.now.id for each in of.drives[1:]]
    maker = [sessions.index(one) for one in brain.map.experiences.array("session").tolist()]
    with mpl.rc_context(STYLE):
        figure = new_figure(10.0, 8.4, "The town, mapped by one robot and by a fleet of four")
        axes = figure.subplots(2, 2, height_ratios=(1.7, 1.0))
        colours = [SESSIONS[k] for k in maker]
        for panel, xy, row, shade in zip(
            axes[0], of.maps, of.rows, ([INK] * len(of.maps[0]), colours), strict=True
        ):
            panel.plot(*of.tour.T, color=WALL, lw=3.0, zorder=0, label="true path")
            panel.scatter(*xy.T, s=7, c=shade, linewidths=0)
            write_title(
                panel, row["robots"],
                f"{row['experiences']} experiences, ATE (rigid) {row['ate_rigid_m']:.2f} m",
            )  # fmt: skip
            panel.set_aspect("equal")
            panel.set_xlabel("x (m)")
            panel.set_ylabel("y (m)")
        for k in range(4):
            axes[0, 1].scatter([], [], s=20, c=SESSIONS[k], label=f"robot {k + 1}")
        legend_below(axes[0, 1], 3)
        for (times_s, share), row, colour in zip(
            of.covered, of.rows, (INK, SESSIONS[5]), strict=True
        ):
            axes[1, 0].plot(times_s, 100.0 * share, color=colour, label=row["robots"])
        axes[1, 0].axhline(95.0, color=WALL, lw=1.0, zorder=0)
        write_title(axes[1, 0], "Streets with a place within 2 m")
        axes[1, 0].set(xlabel="time (s)", ylabel="share of the tour (%)", ylim=(0.0, 104.0))
        axes[1, 0].legend(loc="lower right")
        if len(took):
            axes[1, 1].hist(took, bins=np.arange(0.0, max(2.2, took.max() + 0.1), 0.1),
                            color=SESSIONS[0])  # fmt: skip
            axes[1, 1].axvline(2.0, color=INK, ls="--", lw=1.0)
            axes[1, 1].text(1.97, 0.0, "target ", ha="right", va="bottom")
            write_title(axes[1, 1], "Until others can use a place", f"{len(took)} places")
            axes[1, 1].set(xlabel="time (s)", ylabel="places")
        else:
            axes[1, 1].axis("off")
    return figure
