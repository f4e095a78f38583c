"""A robot finds itself in a finished map, which stays as it is."""

import csv
import math
from itertools import pairwise

import numpy as np
import pytest

from neuroslam import BrainConfig, NavigationBrain, open_source, save_brain
from neuroslam.brain.localise import AGREE, LEAST_FRAMES, LINKS_LARGEST_SHARE, Localiser
from neuroslam.errors import BadFrame, MapError
from neuroslam.types import Frame, Velocity

WORLD = "world:corridor?frames_per_lap=110&width=160&height=120&grey=true"


def mapped(world, stop):
    brain = NavigationBrain(BrainConfig())
    for frame in open_source(world).frames(stop=stop):
        brain(frame)
    return brain


@pytest.fixture(scope="module")
def brain():
    return mapped(WORLD + "&laps=2", 150)


@pytest.fixture(scope="module")
def map_file(brain, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "brain.safetensors"
    save_brain(brain, path)
    return path


@pytest.mark.parametrize("start", [5, 40, 80])
def test_the_robot_is_found_where_it_is_within_twenty_frames(brain, start):
    localiser = Localiser(brain)
    frames = list(open_source(WORLD + "&gain=0.8&seed=3").frames(start, start + 20))
    found = [localiser(frame) for frame in frames]
    assert all(one.pose is None for one in found[: LEAST_FRAMES - 1])
    assert found[-1].pose is not None
    for frame, one in zip(frames, found, strict=True):
        if one.pose is not None:
            at = brain.map.poses[one.experience]
            first = int(brain.map.experiences["first_frame"][one.experience]) % 110
            apart = abs((first - frame.index + 55) % 110 - 55)
            assert apart <= 5
            assert math.dist(one.pose[:2], at[:2]) < 1.0
            assert 0.0 < one.confidence <= 1.0


def test_a_panorama_finds_a_robot_that_drives_the_other_way():
    panorama = "world:corridor?frames_per_lap=110&panoramic=true&grey=true"
    config = BrainConfig(view={"panoramic": True, "template_width": 64, "template_height": 12})
    brain = NavigationBrain(config)
    for frame in open_source(panorama).frames(stop=110):
        brain(frame)
    localiser = Localiser(brain)
    frames = list(open_source(panorama + "&gain=0.9").frames(40, 71))[::-1]
    for i, (before, frame) in enumerate(pairwise(frames)):
        v, w = before.velocity  # backwards in time, facing the other way
        behind = np.roll(frame.image, frame.image.shape[1] // 2, axis=1)
        back = Frame(i, 0.1 * i, behind, Velocity(v, -w))
        found = localiser(back)
    assert found.pose is not None
    assert abs(int(brain.map.experiences["first_frame"][found.experience]) - 40) <= 5
    heading = brain.map.poses[found.experience, 2]
    assert abs(math.remainder(found.pose.theta_rad - heading - math.pi, 2 * math.pi)) < 0.3


def test_a_robot_whose_odometry_is_wrong_is_found_by_the_links_of_the_map(brain, monkeypatch):
    frames = [
        frame._replace(velocity=Velocity(0.3 * frame.velocity.v_m_s, 2.0))
        for frame in open_source(WORLD + "&gain=0.8&seed=3").frames(40, 60)
    ]
    localiser = Localiser(brain)
    last = [localiser(frame) for frame in frames][-1]
    assert last.pose is not None
    first = int(brain.map.experiences["first_frame"][last.experience]) % 110
    assert abs(first - frames[-1].index) <= 5
    monkeypatch.setitem(LINKS_LARGEST_SHARE, False, 0.0)
    by_path = Localiser(brain)
    assert all(by_path(frame).pose is None for frame in frames)


def test_a_robot_in_another_world_is_not_found(brain):
    localiser = Localiser(brain)
    elsewhere = "world:ellipse?frames_per_lap=110&width=160&height=120&grey=true"
    assert all(localiser(frame).pose is None for frame in open_source(elsewhere).frames(stop=60))


def test_a_kidnapped_robot_is_found_again(brain):
    localiser = Localiser(brain)
    frames = list(open_source(WORLD).frames())
    drive = frames[10:35] + frames[75:100]
    found = [localiser(frame._replace(time_s=i / 10)) for i, frame in enumerate(drive)]
    first = brain.map.experiences["first_frame"]
    assert abs(int(first[found[24].experience]) % 110 - 34) <= 5
    assert abs(int(first[found[-1].experience]) % 110 - 99) <= 5


def test_the_map_is_the_same_bit_for_bit_afterwards(brain):
    before = {name: value.clone() for name, value in brain.state_dict().items()}
    localiser = Localiser(brain)
    for frame in open_source(WORLD).frames(20, 40):
        localiser(frame)
    assert all(np.array_equal(before[k], v) for k, v in brain.state_dict().items())


def test_without_images_the_pose_is_followed_by_odometry_and_then_given_up(brain):
    localiser = Localiser(brain)
    frames = list(open_source(WORLD).frames(0, 60))
    for frame in frames[:30]:
        before = localiser(frame)
    blind = [localiser(frame._replace(image=None)) for frame in frames[30:]]
    assert before.pose is not None
    assert blind[0].pose is not None
    assert blind[-1].pose is None
    confidence = [one.confidence for one in blind]
    assert confidence == sorted(confidence, reverse=True)


def test_evidence_of_one_frame_is_not_enough(brain):
    localiser = Localiser(brain)
    found = [localiser(frame) for frame in open_source(WORLD).frames(0, 30)]
    first = next(i for i, one in enumerate(found) if one.pose is not None)
    assert first >= LEAST_FRAMES - 1 + AGREE - 1


def test_what_cannot_be_localised_is_refused(brain):
    with pytest.raises(MapError, match="no views to compare"):
        Localiser(NavigationBrain(BrainConfig()))
    localiser = Localiser(brain)
    localiser(Frame(0, 1.0, None, Velocity(0.1, 0.0)))
    with pytest.raises(BadFrame, match=r"time 1\.0 s does not follow 1\.0 s"):
        localiser(Frame(1, 1.0, None, Velocity(0.1, 0.0)))
    with pytest.raises(BadFrame, match="no odometry"):
        localiser(Frame(1, 1.1, None, None))


def test_the_command_writes_a_row_for_every_frame_and_leaves_the_file_alone(
    call, mistake, map_file, tmp_path
):
    before = map_file.read_bytes()
    out = tmp_path / "poses.csv"
    done = call("localise", map_file, WORLD, "--start", 30, "--stop", 60, "-o", out)
    assert done.code == 0
    assert "Found at frame" in done.out
    assert map_file.read_bytes() == before
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == list(range(30, 60))
    assert rows[0]["found"] == "0"
    assert rows[0]["x_m"] == "nan"
    assert rows[-1]["found"] == "1"
    assert 0.0 < float(rows[-1]["confidence"]) <= 1.0
    message = mistake("localise", map_file, WORLD, "-o", out)
    assert "exists; choose another name or use --overwrite" in message
    assert "is a folder" in mistake("localise", map_file, WORLD, "-o", tmp_path)
