"""A robot that comes back from an unknown place joins its stored map at once, by sequences."""

import numpy as np
import pytest
import torch

from neuroslam.brain import load_brain, save_brain
from neuroslam.brain.soundness import faults_of
from neuroslam.brain.stored_sequence import StoredSequence
from neuroslam.brain.tracker import Mode
from neuroslam.config.sequence import SequenceConfig
from neuroslam.state.files import save_checked
from tests.brain.test_tracker import LAP, brain, drive, laps, strip

AWAY = 110  # frames at the unknown place
SOON = 45  # frames after which the robot knows where it is


def back(phases, first):
    return drive(phases, first=first, seed=3)


@pytest.fixture(scope="module")
def away():
    """A brain after a lap and a half, and a stay elsewhere: its first map is stored."""
    robot = brain(kidnapped_factor=1.3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuroslam.brain.continuity._ROUGH", 1.0)  # frames differ much already
        for frame in drive(laps(1.5)):
            robot(frame)
        known = robot.map.n
        for frame in drive(laps(AWAY / LAP) / 3, strip(5, 7200), round(1.5 * LAP)):
            robot(frame)
        assert [one.map.n for one in robot.stored] == [known]
        yield robot


def copy_of(robot):
    other = type(robot)(robot.config)
    other.load_state_dict(robot.state_dict())
    return other


def test_it_joins_its_first_map_within_two_seconds_and_makes_no_experience_twice(away):
    robot, first = copy_of(away), round(1.5 * LAP) + AWAY
    known = robot.stored[0].map.n
    results = [robot(frame) for frame in back(0.3 + np.arange(SOON + 60) / LAP, first)]
    assert len(robot.sessions.merges) == 1
    joined_at = robot.sessions.merges[0]["at_frame"] - first
    assert joined_at < SOON
    assert robot.map.n == known
    assert robot.tracker.state.mode == Mode.TRACKS
    assert "create" not in {result.action for result in results[joined_at:]}
    frames = robot.map.experiences["first_frame"].numpy()
    phase = frames[robot.map.current] / LAP % 1.0
    assert phase == pytest.approx((0.3 + (SOON + 60) / LAP) % 1.0, abs=0.05)
    assert len(robot.stored) == 1  # the unknown place


def test_a_session_that_begins_on_a_stored_map_is_one_map_with_it(away):
    (lap,) = away.stored
    robot = brain()
    robot.store(lap)
    for frame in back(0.3 + np.arange(SOON + 20) / LAP, 0):
        robot(frame)
    assert len(robot.sessions.merges) == 1
    assert not robot.stored
    assert len(robot.sessions.sessions) == 2


def test_another_unknown_place_is_not_joined(away):
    robot, first = copy_of(away), round(1.5 * LAP) + AWAY
    for frame in drive(laps(0.6) / 3, strip(11, 7200), first, seed=4):
        robot(frame)
    assert not robot.sessions.merges


def test_evidence_goes_on_bit_for_bit_from_a_file(away, tmp_path):
    robot, first = copy_of(away), round(1.5 * LAP) + AWAY
    frames = list(back(0.3 + np.arange(SOON) / LAP, first))
    for frame in frames[:10]:
        robot(frame)
    save_brain(robot, tmp_path / "half")
    again = load_brain(tmp_path / "half")
    assert again.recognition.sequence.state.frames > 5
    for frame in frames[10:]:
        assert robot(frame) == again(frame)
    assert all(torch.equal(a, b) for a, b in zip(robot.state_dict().values(),
               again.state_dict().values(), strict=True))  # fmt: skip


def test_a_brain_of_the_format_before_has_no_evidence_yet(away, tmp_path):
    config = away.config.model_dump(mode="json")
    old = {n: v for n, v in away.state_dict().items() if "recognition.sequence." not in n}
    save_checked(tmp_path / "old", {"format": 7, "config": config}, old)
    assert load_brain(tmp_path / "old").recognition.sequence.state.frames == 0


def test_damaged_evidence_is_a_fault(away):
    state = {name: value.clone() for name, value in away.state_dict().items()}
    state["recognition.sequence.evidence.cost"] = torch.zeros(9999, dtype=torch.float64)
    state["recognition.sequence.state.candidate"] = torch.tensor(10_000)
    faults = faults_of(state, away)
    assert any("9999 rows for" in fault for fault in faults)
    assert any("no experience 10000" in fault for fault in faults)
    assert StoredSequence(SequenceConfig()).believed is False
