"""The fold of a shared map, and the robots that offer to it: facts on short rendered drives."""

import json
import random

import numpy as np
import pytest
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.errors import ConfigError, RunError, SharedMapError
from neuroslam.runs.fleet import fleet
from neuroslam.runs.live_map import FoldThread, LiveRecorder, fold_folder, offer_runs
from neuroslam.runs.verify import verify
from neuroslam.shared_map import Journal, LiveRobot, encode, fold
from neuroslam.shared_map.fold import gather, publication
from neuroslam.shared_map.journal import FILE
from neuroslam.state.files import tensors_digest
from tests.shared_map.test_messages import offer

RING = "world:ellipse?laps=0.5&noise=0.01&width=128&height=32&frames_per_lap=200"
DRIVES = {
    "ada": f"{RING}&start=0.0",
    "bob": f"{RING}&start=0.25&seed=1",
    "wrong": f"{RING}&start=0.1&seed=2",
    "stranger": f"{RING.replace('laps=0.5', 'laps=0.3')}&look=5",
}
STEP = 20  # frames between two offers


def frames(name):
    for frame in open_source(DRIVES[name]).frames():
        v, w = frame.velocity
        yield frame._replace(velocity=(2.0 * v, w)) if name == "wrong" else frame


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    """Every robot's offers, made while it drove, in the order in which they came."""
    folder = tmp_path_factory.mktemp("journal")
    with Journal(folder, BrainConfig()) as journal:
        for name in DRIVES:
            brain = NavigationBrain(BrainConfig())
            robot = LiveRobot(journal, brain, name)
            for frame in frames(name):
                brain(frame)
                if frame.index % STEP == STEP - 1:
                    robot.offer()
            robot.offer()
            save_brain(brain, folder / f"{name}.safetensors")
        return folder, journal.all()


@pytest.fixture(scope="module")
def folded(entries):
    return fold(gather(entries[1]), BrainConfig())


def test_two_robots_that_met_are_one_map_and_the_others_wait(entries, folded):
    assert folded.robots == ("ada", "bob")
    reasons = {row["robot"]: row["reason"] for row in folded.quarantine}
    assert reasons.keys() == {"wrong", "stranger"}
    own = sum(len({*entry_keys(e)}) for e in entries[1] if e.robot in folded.robots)
    assert len(folded.layout) == own
    assert folded.brain.map.n < own


def entry_keys(entry):
    records = gather([entry])
    return records.places


def test_a_robot_with_wrong_odometry_moves_no_place(entries, folded):
    without = [e for e in entries[1] if e.robot in ("ada", "bob")]
    alone = fold(gather(without), BrainConfig())
    np.testing.assert_array_equal(alone.layout, folded.layout)
    assert tensors_digest(alone.brain.state_dict()) == tensors_digest(folded.brain.state_dict())


def test_the_map_does_not_depend_on_the_order_of_arrival(entries, folded):
    shuffled = [*entries[1], *entries[1][::3]]
    random.Random(1).shuffle(shuffled)
    other = fold(gather(shuffled), BrainConfig())
    assert other.digest == folded.digest
    assert other.quarantine == folded.quarantine
    state, same = folded.brain.state_dict(), other.brain.state_dict()
    assert state.keys() == same.keys()
    assert all(torch.equal(state[name], same[name]) for name in state)


def test_the_map_is_an_ordinary_brain(entries, tmp_path):
    report = fold_folder(entries[0], tmp_path / "map")
    assert report.fold["robots"] == ["ada", "bob"]
    assert verify(tmp_path / "map") == []
    brain = load_brain(tmp_path / "map" / "brain.safetensors")
    assert brain.map.n == report.fold["places"]
    assert {len(s.name) for s in brain.sessions.sessions} == {10}
    written = json.loads((tmp_path / "map" / "shared_map.json").read_text())
    assert [row["robot"] for row in written["fold"]["quarantine"]] == ["wrong", "stranger"]


def test_a_place_is_usable_by_others_before_the_next_fold(entries, tmp_path):
    with Journal(tmp_path, BrainConfig()) as journal:
        bob = [e for e in entries[1] if e.robot == "bob"]
        first, last = bob[:-2], bob[-2:]
        for entry in [*first, *(e for e in entries[1] if e.robot == "ada")]:
            journal.offer(entry.robot, entry.message)
        one = fold(gather(journal.all()), BrainConfig())
        assert one.robots == ("ada", "bob")
        journal.publish(publication(one, journal.all()[-1].number))
        ada = LiveRobot(journal, load_brain(entries[0] / "ada.safetensors"))
        before = ada.take()
        for entry in last:
            journal.offer(entry.robot, entry.message)
        assert ada.take() == before + len(gather(last).places)
        seen = ada.recognise(list(open_source(DRIVES["bob"]).frames(stop=98))[-1].image)
        assert seen is not None
        assert seen.robot == "bob"
        assert seen.key in gather(last).places
        robot = LiveRobot(journal, load_brain(entries[0] / "bob.safetensors"))
        robot.take()
        assert robot.name == "bob"
        here = robot.pose
        assert here is not None
        assert np.hypot(here.x_m - seen.pose.x_m, here.y_m - seen.pose.y_m) < 0.5


def test_a_robot_that_was_out_of_reach_catches_up(entries, tmp_path):
    runs = [entries[0] / f"{name}.safetensors" for name in ("ada", "bob")]
    first = offer_runs(tmp_path / "late", runs)
    assert all(row["places"] > 40 for row in first)
    again = offer_runs(tmp_path / "late", runs)
    assert [row["places"] for row in again] == [0, 0]
    assert len(fold_folder(tmp_path / "late").fold["robots"]) == 2


def test_a_lost_journal_does_not_stop_a_robot(tmp_path, monkeypatch):
    brain = NavigationBrain(BrainConfig())
    recorder = LiveRecorder(tmp_path, brain, "ada", every_s=0.0)
    journal = recorder.journal

    def out_of_reach(*_arguments):
        raise SharedMapError("no link")

    drive = list(open_source(DRIVES["ada"]).frames(stop=12))
    for frame in drive[:6]:
        recorder.step(brain(frame), frame, brain)
    known = recorder.robot.n_offered
    monkeypatch.setattr(journal, "offer", out_of_reach)
    for frame in drive[6:]:
        recorder.step(brain(frame), frame, brain)
    assert recorder.robot.n_offered == known
    assert recorder.failure == "no link"
    monkeypatch.undo()
    recorder.close()
    assert recorder.robot.n_offered == brain.map.n
    with Journal(tmp_path) as again:
        assert len(gather(again.all()).places) == brain.map.n


def test_a_robot_that_goes_on_from_an_old_save_begins_a_new_session(entries, tmp_path):
    brain = NavigationBrain(BrainConfig())
    drive = list(open_source(DRIVES["ada"]).frames(stop=30))
    with Journal(tmp_path, BrainConfig()) as journal:
        for frame in drive[:10]:
            brain(frame)
        save_brain(brain, tmp_path / "save.safetensors")
        for frame in drive[10:20]:
            brain(frame)
        LiveRobot(journal, brain, "ada").offer()
        old = load_brain(tmp_path / "save.safetensors")
        robot = LiveRobot(journal, old)
        robot.begin()
        for frame in drive[20:]:
            old(frame)
        robot.offer()
        records = gather(journal.all())
        assert not records.conflicts
        assert len({session for session, _ in records.places}) == 2


def test_a_journal_has_one_config_and_each_session_one_robot(tmp_path):
    with Journal(tmp_path, BrainConfig()):
        pass
    with pytest.raises(ConfigError, match=r"view.threshold is 0.05 and 0.04"):
        Journal(tmp_path, BrainConfig(view={"threshold": 0.04}))
    with pytest.raises(ConfigError, match="expected pose cells and grey views"):
        Journal(tmp_path / "other", BrainConfig(cells=["place"]))
    with Journal(tmp_path) as journal:
        with pytest.raises(SharedMapError, match="templates of 12 pixels; expected 600"):
            journal.offer("ada", encode(offer()))
        with pytest.raises(SharedMapError, match="expected a printable name"):
            journal.offer("a\nb", encode(offer()))
        bare = offer()._replace(pixels=np.zeros((0, 12), np.uint8))
        assert journal.offer("ada", encode(bare)).known is False
        assert journal.offer("ada", encode(bare)).known is True
        more = bare._replace(places=offer(6).places[5:], links=bare.links[:0])
        with pytest.raises(SharedMapError, match="session 000000004d is that of ada"):
            journal.offer("eve", encode(more))
        assert journal.faults() == []
        assert len(journal.all()) == 1


def test_a_damaged_journal_is_named(tmp_path):
    (tmp_path / FILE).write_bytes(b"no database" * 100)
    with pytest.raises(SharedMapError, match="file is not a database"):
        Journal(tmp_path)
    with pytest.raises(SharedMapError, match="holds no shared map"):
        Journal(tmp_path / "nowhere")


def test_a_thread_folds_what_comes(entries, tmp_path):
    with Journal(tmp_path, BrainConfig()) as journal:
        thread = FoldThread(tmp_path, pause_s=0.02)
        thread.start()
        for entry in entries[1][:4]:
            journal.offer(entry.robot, entry.message)
        for _ in range(300):
            published = journal.published()
            if published is not None and published.upto == 4:
                break
            thread._ended.wait(0.02)
        thread.stop()
        assert journal.published().upto == 4
        assert not thread.failure


def test_a_fleet_maps_live_and_its_fold_is_the_merged_map(tmp_path):
    sources = [DRIVES["ada"], DRIVES["bob"], DRIVES["stranger"]]
    report = fleet(sources, tmp_path / "out", live=tmp_path / "shared")
    assert report.merged["sessions"] == [1, 2]
    assert report.merged["ate_rmse_m"] < 0.3
    assert [part["sessions"] for part in report.apart] == [[3]]
    assert "match" in report.apart[0]["reasons"][0]
    assert verify(tmp_path / "out" / "merged") == []
    with pytest.raises(RunError, match="holds a shared map already"):
        fleet(sources, tmp_path / "again", live=tmp_path / "shared")
