"""A running session recognises where it is: stored maps, carried robots, and wrong places."""

from itertools import pairwise, product

import numpy as np
import pytest
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.merging.match import find_match
from neuroslam.runs.run import resolve_config
from neuroslam.sensors import open_source
from neuroslam.view.templates import LocalViewCells

LAP = 400


def frames_of(spec, first=0, last=None, rate=20.0):
    return list(open_source(spec, rate).frames(first, last))


def lived(frames, config=None, stored=()):
    brain = NavigationBrain(config)
    for one in stored:
        brain.store(one)
    for frame in frames:
        brain(frame)
    return brain


def sizes(brain):
    return brain.view.n, brain.map.n, brain.map.n_links


def equal(one, other):
    a, b = one.state_dict(), other.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def in_order(frames, numbers):
    """These frames as one recording: whoever drives through them jumps where numbers do."""
    return [frames[i]._replace(index=k, time_s=0.1 * k) for k, i in enumerate(numbers)]


# --- the virtual tour: three quarters of a lap, then laps from an unknown start -------------------


@pytest.fixture(scope="module")
def tour():
    return frames_of("world:ellipse?laps=4&width=256&height=64", 0, 4 * LAP)


@pytest.fixture(scope="module")
def first(tour):
    return lived(tour[:300])


@pytest.fixture(scope="module")
def single(tour):
    brain = NavigationBrain()
    after_900 = None
    for frame in tour:
        brain(frame)
        if frame.index == 899:
            after_900 = sizes(brain)
    return brain, after_900


@pytest.fixture(scope="module")
def joined(tour, first):
    return lived(tour[320:], stored=[first])


def created_where_known(brain):
    """Places made after the merge where a session had been: but for 300 to 319, all of the lap."""
    (report,) = brain.sessions.merges
    made = brain.map.experiences["first_frame"].numpy()
    known = (made % LAP < 300) | (made % LAP >= 320)
    return made[(made > report["at_frame"]) & known]


def test_two_sessions_make_the_map_of_one(joined, single):
    assert len(joined.stored) == 0
    assert sizes(joined) == sizes(single[0])


def test_no_place_is_made_anew_after_the_merge(joined):
    assert len(created_where_known(joined)) == 0


def test_the_robot_is_at_the_loaded_place_at_once(tour, first):
    brain = lived(tour[320:410], stored=[first])
    at = None
    for frame in tour[410:430]:
        result = brain(frame)
        if brain.sessions.merges:
            at = result
            break
    (report,) = brain.sessions.merges
    assert at.frame == report["at_frame"]
    assert at.action == "set"
    assert at.experience == brain.map.current == report["match"]["loaded_experience"]
    assert at.view.template == report["match"]["loaded_view"]
    assert not at.view.is_new
    assert (at.n_templates, at.n_experiences, at.n_links) == sizes(brain)
    assert at.cells == brain.pose_cells.estimate
    assert at.pose == brain.map.pose


@pytest.mark.parametrize("cells", ["none", "shift"])
def test_without_moving_and_turning_the_pose_cells_known_places_are_made_anew(
    cells, tour, first, single
):
    """Figure 12 of the paper; its shift alone leaves the ways turned by the other start."""
    config = BrainConfig(sessions={"cells": cells})
    brain = lived(tour[320:900], config, [first])
    assert len(brain.sessions.merges) == 1
    assert len(created_where_known(brain)) > 0
    assert brain.map.n > single[1][1]
    assert brain.map.n_links > single[1][2]


def test_a_lower_confirm_joins_earlier(tour, first):
    at = []
    for confirm in (1, 2, 4, 8):
        brain = lived(tour[320:450], BrainConfig(sessions={"confirm": confirm}), [first])
        (report,) = brain.sessions.merges
        at.append(report["at_frame"])
        assert report["match"]["places"] >= confirm
    assert at == sorted(at)
    assert at[0] < at[2] < at[3]


def test_a_session_that_starts_inside_the_stored_map_localises_and_adds_nothing(tour, first):
    brain = lived(tour[100:290], stored=[first])
    (report,) = brain.sessions.merges
    assert report["at_frame"] < 120
    assert report["reason"] == "no experience is new"
    assert sizes(brain) == sizes(first)
    for name in ("cell", "template", "first_frame", "session", "number"):
        assert torch.equal(brain.map.experiences[name], first.map.experiences[name])
    np.testing.assert_allclose(brain.map.poses, first.map.poses, rtol=0, atol=1e-9)


def test_storing_does_not_change_what_is_stored(tour):
    one = lived(tour[:100])
    before = {k: v.clone() for k, v in one.state_dict().items()}
    lived(tour[50:120], stored=[one])
    assert all(torch.equal(v, before[k]) for k, v in one.state_dict().items())


def test_a_map_made_with_other_views_cannot_be_stored(first):
    brain = NavigationBrain(BrainConfig(view={"threshold": 0.04}))
    with pytest.raises(ConfigError, match=r"view\.threshold is 0\.04 and 0\.05"):
        brain.store(first)
    assert len(brain.stored) == 0


# --- several stored maps --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def halves(tour):
    return lived(tour[:120]), lived(tour[160:300])


def test_both_of_two_stored_maps_are_joined_once_recognised(tour, halves, single):
    brain = lived(tour[320:900], stored=halves)
    assert len(brain.stored) == 0
    assert [len(r["loaded_sessions"]) for r in brain.sessions.merges] == [1, 1]
    one, two = (r["at_frame"] for r in brain.sessions.merges)
    assert one % LAP < 120
    assert 160 <= two % LAP < 300
    assert len(brain.sessions.sessions) == 3
    assert sizes(brain) == single[1]


def test_one_search_serves_all_stored_maps(tour, halves, monkeypatch):
    brain = NavigationBrain()
    for one in halves:
        brain.store(one)
    memories, search = [], LocalViewCells.search

    def spy(self, *args):
        memories.append(self)
        return search(self, *args)

    monkeypatch.setattr(LocalViewCells, "search", spy)
    for frame in tour[320:380]:
        memories.clear()
        result = brain(frame)
        stored = [memory for memory in memories if memory is not brain.view]
        assert len(stored) == (result.action in ("create", "link"))
        assert all(memory.n == halves[0].view.n + halves[1].view.n for memory in stored)


def test_a_map_that_is_not_joined_has_a_reason(tour, first):
    brain = lived(tour[320:395], stored=[first])
    (said,) = brain.not_joined()
    assert said["sessions"] == [s.name for s in first.sessions.sessions]
    assert said["experiences"] == first.map.n
    assert said["places_that_agree"] < 4
    assert "expected 4" in said["reason"]
    for frame in tour[395:420]:
        brain(frame)
    assert brain.not_joined() == []


def test_two_stored_maps_of_one_session_are_one_stored_map(tour):
    """A map, and what became of it: one place is stored once."""
    before, after = lived(tour[:100]), lived(tour[:200])
    for order in ((before, after), (after, before)):
        brain = NavigationBrain()
        for one in order:
            brain.store(one)
        (stored,) = brain.stored
        assert sizes(stored) == sizes(after)
        assert brain.recognition.tally.n == 1


# --- carried ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corridor():
    return frames_of("world:corridor?laps=2")


def test_a_kidnapped_robot_keeps_its_map_and_relocalises_in_it(corridor):
    order = [*range(250), *range(100, 300)]
    brain, known = NavigationBrain(), None
    when = []
    for k, frame in enumerate(in_order(corridor, order)):
        before = len(brain.stored)
        brain(frame)
        if len(brain.stored) != before:
            when.append((k, len(brain.stored)))
            known = known or sizes(brain.stored[0])
    assert [n for _, n in when] == [1, 0]
    assert when[0][0] == 250
    assert when[1][0] < 280
    (report,) = brain.sessions.merges
    assert report["reason"] == "no experience is new"
    assert [s.began for s in brain.sessions.sessions] == ["start", "kidnapped"]
    # Frames 250 to 299 are new ground: then it is the map of one who was never carried.
    uncarried = lived(corridor[:300])
    assert sizes(brain)[:2] == sizes(uncarried)[:2]
    made = brain.map.experiences["first_frame"].numpy()
    assert ((made < 250) | (made >= 400 - 1)).all()


def test_a_robot_kidnapped_to_unmapped_ground_joins_its_maps_at_the_loop_closure(corridor):
    order = [*range(150), *range(300, 681)]  # a lap is 340 frames: 300 to 340 is unknown
    brain = lived(in_order(corridor, order)[:190])
    assert len(brain.stored) == 1
    assert brain.sessions.merges == []
    for frame in in_order(corridor, order)[190:]:
        brain(frame)
    assert len(brain.stored) == 0
    (report,) = brain.sessions.merges
    assert 190 <= report["at_frame"] < 230
    assert report["counts"]["experiences"]["merged"] > report["counts"]["experiences"]["loaded"]


def test_with_kidnapped_ignore_the_map_is_continued(corridor):
    config = BrainConfig(sessions={"kidnapped": "ignore"})
    brain = lived(in_order(corridor, [*range(250), *range(100, 150)]), config)
    assert len(brain.stored) == 0
    assert [s.began for s in brain.sessions.sessions] == ["start"]


@pytest.mark.parametrize("spec", ["corridor?people=4&noise=0.05&light=0.3", "figure_eight"])
def test_a_drive_without_a_jump_is_one_session(spec):
    brain = lived(frames_of(f"world:{spec}"))
    assert [s.began for s in brain.sessions.sessions] == ["start"]
    assert len(brain.stored) == 0


@pytest.fixture(scope="module")
def with_a_gap(corridor):
    before = in_order(corridor, range(150))
    later = in_order(corridor, [*range(150), *range(60, 120)])[150:]
    return before + [frame._replace(time_s=frame.time_s + 60.0) for frame in later]


def test_after_a_long_gap_a_new_map_is_begun_and_joined(with_a_gap):
    brain = NavigationBrain(BrainConfig(sessions={"after_gap": "new_map", "kidnapped": "ignore"}))
    for k, frame in enumerate(with_a_gap):
        brain(frame)
        if k == 150:
            assert len(brain.stored) == 1
            assert brain.map.n == 1
    assert [s.began for s in brain.sessions.sessions] == ["start", "gap"]
    assert len(brain.stored) == 0
    (report,) = brain.sessions.merges
    assert report["at_frame"] < 180
    assert sizes(brain)[:2] == sizes(lived(with_a_gap[:150]))[:2]


def test_a_long_gap_is_an_error_unless_asked_otherwise(with_a_gap):
    brain = lived(with_a_gap[:150])
    with pytest.raises(BadFrame, match="max_gap_s"):
        brain(with_a_gap[150])
    assert len(brain.stored) == 0
    assert [s.began for s in brain.sessions.sessions] == ["start"]


# --- save, load, go on ----------------------------------------------------------------------------


def test_a_session_saved_before_at_and_after_its_merge_goes_on_bit_for_bit(tour, first, tmp_path):
    uncut = NavigationBrain()
    uncut.store(first)
    kinds = {}
    for frame in tour[320:480]:
        merges = len(uncut.sessions.merges)
        uncut(frame)
        pending = uncut.recognition.sightings.n
        kind = None
        if len(uncut.sessions.merges) > merges:
            kind = "at the merge"
        elif merges:
            kind = "after the merge" if frame.index == 440 else None
        elif pending:
            kind = f"{pending} sightings pending"
        elif frame.index == 350:
            kind = "nothing seen yet"
        if kind and kind not in kinds:
            kinds[kind] = frame.index + 1
            save_brain(uncut, tmp_path / f"{frame.index + 1}.safetensors")
    assert {"nothing seen yet", "at the merge", "after the merge"} < set(kinds)
    assert any("pending" in kind for kind in kinds)
    for kind, at in kinds.items():
        resumed = load_brain(tmp_path / f"{at}.safetensors")
        for frame in tour[at:480]:
            resumed(frame)
        assert equal(resumed, uncut), kind


@pytest.mark.parametrize("at", [249, 250, 251, 256, 262])
def test_a_kidnapped_robot_saved_at_any_moment_goes_on_bit_for_bit(at, corridor, tmp_path):
    frames = in_order(corridor, [*range(250), *range(100, 180)])
    uncut = NavigationBrain()
    for k, frame in enumerate(frames):
        if k == at:
            save_brain(uncut, tmp_path / "brain.safetensors")
        uncut(frame)
    assert len(uncut.sessions.merges) == 1
    resumed = load_brain(tmp_path / "brain.safetensors")
    for frame in frames[at:]:
        resumed(frame)
    assert equal(resumed, uncut)


def test_two_stored_maps_that_wait_are_saved_too(tour, halves, tmp_path):
    brain = lived(tour[320:390], stored=halves)
    assert len(brain.stored) == 2
    save_brain(brain, tmp_path / "brain.safetensors")
    resumed = load_brain(tmp_path / "brain.safetensors")
    assert equal(resumed, brain)
    for frame in tour[390:620]:
        brain(frame)
        resumed(frame)
    assert len(brain.stored) == 0
    assert equal(resumed, brain)


# --- wrong places ---------------------------------------------------------------------------------


def cut_lives(frames, config=None, starts=(0, 90, 180, 270, 360), length=240):
    frames = frames[: starts[-1] + length]
    return frames, [lived(frames[k : k + length], config) for k in starts]


@pytest.fixture(scope="module")
def corridor_lives(corridor):
    return cut_lives(corridor)


@pytest.mark.parametrize("other", ["ellipse?laps=2", "corridor?laps=2&look=5"])
def test_different_worlds_are_never_joined(other, corridor_lives):
    """Of the second, rooms and ways are the same and the pictures others."""
    frames, ones = corridor_lives
    other_frames, others = cut_lives(frames_of(f"world:{other}", 0, 600))
    assert len(ones) * len(others) >= 25
    for one, two in product(ones, others):
        for found in (find_match(one, two), find_match(two, one)):
            assert found.match is None
            assert "match" in found.reason
    for stored, drive in ((ones[0], other_frames[:400]), (others[0], frames[:400])):
        brain = lived(drive, stored=[stored])
        assert brain.sessions.merges == []
        (said,) = brain.not_joined()
        assert "expected 4" in said["reason"]


def test_different_real_places_are_never_joined(shared):
    config = resolve_config("rc_car")
    recordings = [
        cut_lives(
            frames_of(str(shared / "data" / name / "frames.tar"), 0, 720, config.frame_rate_hz),
            config, (0, 160, 320, 480), 240,
        )
        for name in ("circuit_launch", "usi_track1")
    ]  # fmt: skip
    (frames, ones), (other_frames, others) = recordings
    for one, two in product(ones, others):
        found = find_match(one, two)
        assert found.match is None
        assert "match" in found.reason
    for stored, drive in ((ones[1], other_frames[:400]), (others[1], frames[:400])):
        assert lived(drive, config, [stored]).sessions.merges == []


def test_lives_that_overlap_are_joined_where_the_same_search_refuses_others(corridor_lives):
    """The refusals above are worth something: the same lives, cut from one drive, do meet."""
    _, lives = corridor_lives
    for one, two in pairwise(lives):
        found = find_match(one, two)
        assert found.match is not None, found.reason
        merged, report = one.merge(two, found.match)
        assert merged is not None, report.reason
        other_way, report = two.merge(one, find_match(two, one).match)
        assert other_way is not None, report.reason
        assert abs(other_way.map.n - merged.map.n) <= 2
