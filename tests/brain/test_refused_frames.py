"""A frame is taken whole or not at all, by any set of populations."""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.config.populations import registered
from neuroslam.config.sections import OdometryConfig
from neuroslam.errors import BadFrame, ConfigError, MapError, RunError
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.runs.run import run
from neuroslam.sensors import open_source
from neuroslam.state.population import Correction, Population
from neuroslam.state.registry import register
from neuroslam.types import Frame, Velocity

SEVEN = [
    "pose", "place", "semantic", "pose+place", "pose+semantic", "place+semantic",
    "pose+place+semantic",
]  # fmt: skip
SETS = [*SEVEN, *(f"{cells}+head_direction+speed" for cells in SEVEN)]
LIVED = 6
"""Frames before the first that is refused."""

ALL = frozenset(["pose", "place", "semantic"])
WALLS = frozenset(["place"])
MARKS = frozenset(["semantic"])
COMPASS = frozenset(["place", "semantic", "head_direction"])
VIEWS = frozenset(["pose"])
NAN, INF = math.nan, math.inf


class Bad(NamedTuple):
    """What is wrong with a frame, who minds, and what it is told."""

    change: dict
    who: frozenset = ALL
    said: str = ""
    error: type[Exception] = BadFrame


def walls(value) -> dict:
    return {"walls": value}


def scan(value) -> dict:
    return {"walls": None, "ranges": value}


def marks(value) -> dict:
    return {"landmarks": value}


BAD = {
    "time that stands still": Bad({"time_s": 0.0}, said="times must rise"),
    "time that goes back": Bad({"time_s": -0.05}, said="times must rise"),
    "time NaN": Bad({"time_s": NAN}, said="times must rise and be finite"),
    "time without end": Bad({"time_s": INF}, said="times must rise and be finite"),
    "time of text": Bad({"time_s": "noon"}, said="its time is 'noon'"),
    "no time": Bad({"time_s": None}, said="its time is None"),
    "gap": Bad({"time_s": 900.0}, said="expected at most max_gap_s"),
    "index of a fraction": Bad({"index": 1.5}, said="its index is 1.5"),
    "index of text": Bad({"index": "one"}, said="its index is 'one'"),
    "index too large": Bad({"index": 2**63}, said="its index is"),
    "float picture": Bad({"image": np.ones((40, 64))}, said="image is float64 (40, 64)"),
    "picture of rows": Bad({"image": np.ones(64, np.uint8)}, said="image is uint8 (64,)"),
    "picture with alpha": Bad({"image": np.ones((40, 64, 4), np.uint8)}, said="image is uint8"),
    "picture without pixels": Bad({"image": np.ones((0, 64), np.uint8)}, said="image is uint8"),
    "picture of text": Bad({"image": "a.png"}, said="image is 'a.png'"),
    "picture of a tensor": Bad({"image": torch.zeros(40, 64)}, said="not a numpy array"),
    "picture too small for views": Bad(
        {"image": np.ones((4, 6), np.uint8)}, VIEWS, "make the template smaller", ConfigError
    ),
    "no odometry and no picture": Bad({"velocity": None, "image": None}, said="and no image"),
    "odometry NaN": Bad({"velocity": Velocity(NAN, 0.0)}, said="odometry v = nan m/s"),
    "odometry without end": Bad({"velocity": Velocity(0.0, INF)}, said="w = inf rad/s"),
    "odometry alone": Bad({"velocity": 0.5}, said="odometry is 0.5"),
    "odometry of three": Bad({"velocity": (0.1, 0.0, 0.0)}, said="odometry is of type tuple"),
    "odometry of text": Bad({"velocity": ("1", "0")}, said="odometry is of type tuple"),
    "odometry of no robot": Bad({"velocity": Velocity(1e200, 0.0)}, said="v = 1e+200 m/s"),
    "turn rate of no robot": Bad({"velocity": Velocity(0.0, -1e20)}, said="w = -1e+20 rad/s"),
    "heading NaN": Bad({"heading_rad": NAN}, COMPASS, "heading nan rad"),
    "heading without end": Bad({"heading_rad": -INF}, COMPASS, "heading -inf rad"),
    "heading of text": Bad({"heading_rad": "north"}, COMPASS, "heading is 'north'"),
    "heading of a list": Bad({"heading_rad": [0.1]}, COMPASS, "heading is of type list"),
    "walls behind the robot": Bad(walls(np.array([[-0.1, 0.0]])), WALLS, "distance -0.1 m"),
    "walls NaN": Bad(walls(np.array([[0.3, 0.0], [NAN, 1.0]])), WALLS, "distance nan m"),
    "walls of no bearing": Bad(walls(np.array([[0.3, INF]])), WALLS, "bearing inf rad"),
    "walls of three columns": Bad(walls(np.ones((4, 3))), WALLS, "walls have shape (4, 3)"),
    "walls of objects": Bad(walls(np.array([[None, 1.0]])), WALLS, "walls are an array of objects"),
    "walls of text": Bad(walls("left"), WALLS, "walls are 'left'"),
    "ranges NaN": Bad(scan(np.r_[NAN, np.ones(35)]), WALLS, "beam 0 measures nan m"),
    "ranges below zero": Bad(scan(np.r_[np.ones(35), -1.0]), WALLS, "beam 35 measures -1.0 m"),
    "ranges of two columns": Bad(scan(np.ones((36, 2))), WALLS, "ranges have shape (36, 2)"),
    "ranges too few": Bad(scan(np.ones(7)), WALLS, "at least 8 beams"),
    "ranges of text": Bad(scan(["far"] * 36), WALLS, "ranges are an array of text"),
    "landmarks behind the robot": Bad(marks(np.array([[1.0, -2.0, 0.0]])), MARKS, "is negative"),
    "landmarks NaN": Bad(marks(np.array([[1.0, NAN, 0.0]])), MARKS, "not a number"),
    "landmarks of no bearing": Bad(marks(np.array([[1.0, 2.0, INF]])), MARKS, "not a number"),
    "landmarks of two columns": Bad(marks(np.ones((3, 2))), MARKS, "have shape (3, 2)"),
    "landmarks between numbers": Bad(marks(np.array([[1.5, 2.0, 0.0]])), MARKS, "the number 1.5"),
    "landmarks of objects": Bad(marks(object()), MARKS, "landmarks are of type object"),
    "motion out of the space": Bad(
        {"velocity": Velocity(1e5, 0.0)}, MARKS, "outside of its space", MapError
    ),
}

NO_ODOMETRY = {
    "picture of another size": Bad({"image": np.ones((50, 64), np.uint8)}, said="64 x 50 px"),
    "picture of another width": Bad({"image": np.ones((40, 70), np.uint8)}, said="70 x 40 px"),
    "colours of another size": Bad({"image": np.ones((40, 80, 3), np.uint8)}, said="80 x 40 px"),
    "no odometry and no picture": BAD["no odometry and no picture"],
    "float picture": BAD["float picture"],
    "heading NaN": BAD["heading NaN"],
    "walls NaN": BAD["walls NaN"],
    "landmarks NaN": BAD["landmarks NaN"],
}


@cache
def frames() -> list[Frame]:
    """A drive that has everything: pictures, ranges, posts, compass, odometry."""
    return list(
        open_source(
            "world:corridor?width=64&height=40&noise=0.03&compass_deg=2&ranges=36&markers=12"
            "&landmark_reach=6&frames_per_lap=150&laps=0.45"
        )
    )


def brain_of(cells: str, **over) -> NavigationBrain:
    sections = {"cells": cells, "sessions": {"after_gap": "stop"}, **over}
    return NavigationBrain(build_config(merge_values(read_preset("full"), sections)))


def spoilt(frame: Frame, bad: Bad, last_s: float) -> Frame:
    """A frame with something wrong in it; numbers of time are told from the last one's."""
    change = dict(bad.change)
    if isinstance(change.get("time_s"), float):
        change["time_s"] += last_s
    return frame._replace(**change)


def state_of(brain: NavigationBrain) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in brain.state_dict().items()}


def changed(before: dict[str, torch.Tensor], brain: NavigationBrain) -> list[str]:
    after = brain.state_dict()
    return [
        *sorted(before.keys() ^ after.keys()),
        *(k for k in before if k in after and not same(before[k], after[k])),
    ]


def same(one: torch.Tensor, other: torch.Tensor) -> bool:
    return one.dtype == other.dtype and torch.equal(one, other)


def refusal(brain: NavigationBrain, frame: Frame, bad: Bad) -> str:
    """Let a brain refuse a frame; returns what is not as it should be, or nothing."""
    before = state_of(brain)
    try:
        brain(frame)
    except bad.error as fault:
        said = "" if bad.said in str(fault) else f"said: {fault}"
    except Exception as fault:
        said = f"{type(fault).__name__}: {fault}"
    else:
        said = "was taken"
    names = changed(before, brain)
    return said or (f"half taken: {names}" if names else "")


def minded(cells: str, kinds: dict[str, Bad]) -> dict[str, Bad]:
    return {name: bad for name, bad in kinds.items() if bad.who & set(cells.split("+"))}


def lives_with(kinds: dict[str, Bad], drive: list[Frame], *brains: NavigationBrain) -> dict:
    """Let one brain meet a bad frame before each good one, and its twin the good ones alone.

    Returns:
        What went wrong, by kind.
    """
    brain, twin = brains
    faults = {}
    for frame in drive[:LIVED]:
        assert brain(frame) == twin(frame)
    for frame, (kind, bad) in zip(drive[LIVED:], kinds.items(), strict=False):
        fault = refusal(brain, spoilt(frame, bad, brain.clock.time_s), bad)
        if not fault and brain(frame) != twin(frame):
            fault = "goes on in another way"
        if fault:
            faults[kind] = fault
            break
    assert len(drive) >= LIVED + len(kinds)
    return faults


@pytest.mark.parametrize("cells", SETS)
def test_what_is_refused_changes_nothing_and_the_brain_goes_on_as_if_it_had_never_been(cells):
    brain, twin = brain_of(cells), brain_of(cells)
    assert lives_with(minded(cells, BAD), frames(), brain, twin) == {}
    assert changed(state_of(twin), brain) == []


@pytest.mark.parametrize("cells", SEVEN)
def test_a_brain_without_odometry_refuses_pictures_whole_too(cells):
    drive = [frame._replace(velocity=None) for frame in frames()]
    brain, twin = brain_of(cells), brain_of(cells)
    assert lives_with(minded(cells, NO_ODOMETRY), drive, brain, twin) == {}
    assert changed(state_of(twin), brain) == []


FIRST = {kind: bad for kind, bad in BAD.items() if kind not in
         ("time that stands still", "time that goes back", "gap")}  # fmt: skip


@pytest.mark.parametrize("cells", SETS)
def test_a_brain_that_has_seen_nothing_yet_refuses_a_frame_whole_too(cells):
    brain, twin = brain_of(cells), brain_of(cells)
    faults = {
        kind: refusal(brain, spoilt(frames()[0], bad, 0.0), bad)
        for kind, bad in minded(cells, FIRST).items()
    }
    assert {kind: fault for kind, fault in faults.items() if fault} == {}
    for frame in frames()[:3]:
        assert brain(frame) == twin(frame)
    assert changed(state_of(twin), brain) == []


def test_what_a_picture_of_another_size_showed_is_forgotten_when_its_frame_was_refused():
    odometry, twin = (VisualOdometry(OdometryConfig(max_shift_px=8)) for _ in range(2))
    small, large = np.zeros((20, 30), np.uint8), np.zeros((40, 64), np.uint8)
    large[:, 40:] = 200
    odometry.measure(small, 0.1)  # and its frame is refused by others: it is not remembered
    moved = np.roll(large, 3, axis=1)
    for picture in (large, moved):
        assert odometry(picture, 0.1) == twin(picture, 0.1)
    assert torch.equal(odometry.turn_sums, twin.turn_sums)


# --- frames that are taken, but move the robot out of the space -------------------------------


class Shove(Population):
    """Says once that the robot is far away."""

    says = recalls = None

    def step(self, now, observation):
        told, self.says = self.says, None
        return told

    def recall(self, now, observation, belief):
        told, self.recalls = self.recalls, None
        return told


@pytest.fixture
def shove():
    """A kind of population that moves all others."""
    register("shove")(Shove)
    yield
    registered.pop("shove")


@pytest.mark.parametrize("cells", ["pose+semantic", "pose+place+semantic", "place+semantic"])
@pytest.mark.parametrize("when", ["says", "recalls"])
def test_a_correction_may_leave_the_space_and_then_the_next_frame_is_refused(cells, when, shove):
    brain = brain_of(f"{cells}+shove")
    for frame in frames()[:LIVED]:
        brain(frame)
    there = (500.0, 0.0)
    setattr(brain.shove, when, Correction(*there, position_m=there, sigma_m=0.1, relocalises=True))
    at = brain(frames()[LIVED]).pose  # no exception in the middle of it
    assert math.hypot(*at[:2]) > 400.0
    assert brain.clock.frames_seen == LIVED + 1
    for frame in frames()[LIVED + 1 : LIVED + 3]:
        out = Bad({}, MARKS, "outside of its space", MapError)
        assert refusal(brain, frame, out) == ""


# --- errors after the state has begun to change -----------------------------------------------


class Faulty(Population):
    """Raises an error in one of its methods, if it is told to."""

    fails = error = None

    def fail(self, hook):
        if hook == self.fails:
            raise self.error

    def step(self, now, observation):
        self.fail("step")

    def vetoes(self, view):
        self.fail("vetoes")
        return False

    def follow(self, correction):
        self.fail("follow")

    def learn(self, now, observation):
        self.fail("learn")

    def recall(self, now, observation, belief):
        self.fail("recall")


HOOKS = ["step", "vetoes", "follow", "learn", "recall"]


@pytest.fixture
def faulty(shove):
    """A brain with a population that fails, and its state before the frame in which it does."""
    register("faulty")(Faulty)
    brain = brain_of("pose+head_direction+shove+faulty")
    for frame in frames()[:LIVED]:
        brain(frame)
    before = state_of(brain)
    brain.shove.says = Correction(0.1)  # so that there is something to follow
    yield brain, before
    registered.pop("faulty")


@pytest.mark.parametrize("hook", HOOKS)
def test_a_bad_frame_after_check_is_an_error_of_the_program_and_breaks_the_brain(hook, faulty):
    brain, before = faulty
    brain.faulty.fails, brain.faulty.error = hook, BadFrame("too dark")
    said = rf"frame {LIVED}: Faulty\.{hook}\(\) raised BadFrame \(too dark\) after the state"
    with pytest.raises(RuntimeError, match=f"{said} had changed; refuse a frame in observe or"):
        brain(frames()[LIVED])
    brain.faulty.fails = brain.shove.says = None
    whole = brain_of("pose+head_direction+shove+faulty")
    broken = rf"frame {LIVED} is half taken: Faulty\.{hook}\(\) was interrupted by BadFrame"
    for use in (lambda: brain(frames()[LIVED + 1]), brain.state_dict, lambda: whole.store(brain)):
        with pytest.raises(RuntimeError, match=broken):
            use()
    brain.load_state_dict(before)
    assert changed(before, brain) == []
    whole.load_state_dict(before)
    assert brain(frames()[LIVED]) == whole(frames()[LIVED])


@pytest.mark.parametrize("error", [ValueError("no such cell"), MapError("out"), KeyboardInterrupt])
def test_any_other_error_stays_what_it_is_and_breaks_the_brain(error, faulty):
    brain, _ = faulty
    brain.faulty.fails, brain.faulty.error = "learn", error
    with pytest.raises(error if isinstance(error, type) else type(error)):
        brain(frames()[LIVED])
    assert "Faulty.learn() was interrupted by" in brain.half_taken


def test_a_run_does_not_write_a_map_of_a_frame_half_taken(faulty, tmp_path, monkeypatch):
    def learn(self, now, observation):
        if now.frame == 3:
            raise MapError("no such cell")

    monkeypatch.setattr(Faulty, "learn", learn)
    config = build_config({"cells": "pose+faulty"})
    world = "world:corridor?width=64&height=40&frames_per_lap=150"
    said = r"no such cell; the map is not written: frame 3 is half taken: Faulty\.learn\(\)"
    with pytest.raises(RunError, match=said):
        run(world, tmp_path / "out", config, tensorboard=False)
    assert not (tmp_path / "out" / "brain.safetensors").exists()
