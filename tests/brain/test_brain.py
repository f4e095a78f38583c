"""The whole brain: parity with the reference, truth, determinism, frames it cannot use."""

import csv
import dataclasses

import numpy as np
import pytest
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.evaluation.trajectory import absolute_trajectory_error, shape_rmse
from neuroslam.geometry import integrate_velocities
from neuroslam.runs.run import resolve_config
from neuroslam.sensors import open_source
from neuroslam.types import Frame, Pose, Velocity

PICTURE = np.add.outer(np.arange(120), np.arange(160)).astype(np.uint8)


def read_rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", ["circuit_launch", "usi_track1"])
def test_a_real_drive_gives_the_map_of_the_reference(shared, name):
    """C++ OpenRatSLAM on the same frames: ids and odometry equal, the map alike."""
    refs = shared / "refs" / "ratslam"
    brain = NavigationBrain(resolve_config("openratslam", refs / f"config_{name}.ini"))
    source = open_source(shared / "data" / name / "frames.tar", 20.0)
    wanted = read_rows(refs / f"{name}_sync_frames.csv")
    results = [brain(frame) for frame in source.frames()]
    assert [r.view.template for r in results] == [int(row["vt_id"]) for row in wanted]
    for column, found in (
        ("vtrans", [r.motion.v_m_s for r in results]),
        ("vrot", [r.motion.w_rad_s for r in results]),
        ("vt_error", [r.view.error for r in results]),
    ):
        np.testing.assert_allclose(found, [float(row[column]) for row in wanted], atol=1e-9)
    last = wanted[-1]
    assert brain.map.n == pytest.approx(int(last["n_exp"]), rel=0.05)
    assert brain.map.n_links == pytest.approx(int(last["n_links"]), rel=0.05)
    theirs = np.loadtxt(refs / f"{name}_sync_experiences.csv", delimiter=",", skiprows=1)
    ours = brain.map.poses[[r.experience for r in results], :2]
    assert shape_rmse(ours, theirs[[int(row["exp_id"]) for row in wanted], 1:3]) < 0.05


def test_the_map_of_a_noisy_drive_is_closer_to_the_truth_than_odometry():
    brain = NavigationBrain(BrainConfig())
    frames = list(open_source("world:corridor?laps=2&noise=0.05").frames())
    results, offsets = [], []
    for frame in frames:
        results.append(brain(frame))
        offsets.append(brain.map.offset)
    track = np.array(
        [brain.place(r.experience, at) for r, at in zip(results, offsets, strict=True)]
    )
    truth = np.array([frame.truth for frame in frames])
    motion = np.array([r.motion for r in results])
    odometry = integrate_velocities(*motion.T, start=Pose(0.0, 0.0, np.pi / 2))
    ate = absolute_trajectory_error(track[:, :2], truth[:, :2]).rmse
    alone = absolute_trajectory_error(odometry[:, :2], truth[:, :2]).rmse
    assert ate < 0.3 * alone
    assert brain.view.n < 0.6 * len(frames) / 2  # the second lap is recognised, not learnt anew


def test_the_second_lap_of_a_known_world_makes_no_new_places():
    brain = NavigationBrain(BrainConfig())
    frames = list(open_source("world:corridor?laps=2&noise=0.05").frames())
    first = [brain(frame) for frame in frames[:360]][-1]
    last = [brain(frame) for frame in frames[360:]][-1]
    assert last.n_templates == first.n_templates
    assert last.n_experiences <= first.n_experiences + 2


def test_two_brains_on_one_stream_are_equal():
    states = []
    for _ in range(2):
        brain = NavigationBrain(BrainConfig())
        for frame in open_source("world:ellipse?noise=0.1&seed=5").frames(0, 60):
            brain(frame)
        states.append(brain.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(*(s.values() for s in states), strict=True))


def seen(n=3):
    brain = NavigationBrain(BrainConfig())
    for i in range(n):
        brain(Frame(i, i / 20, np.roll(PICTURE, 5 * i, axis=1), Velocity(0.5, 0.0)))
    return brain


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (Frame(3, 0.05, PICTURE, Velocity(1, 0)), r"frame 3: time 0\.05 s does not follow 0\.1 s"),
        (Frame(3, float("nan"), PICTURE, Velocity(1, 0)), "times must rise"),
        (Frame(3, 60.0, PICTURE, Velocity(1, 0)), r"expected at most max_gap_s = 2\.0 s; raise it"),
        (Frame(3, 0.15, PICTURE, Velocity(float("nan"), 0)), "v = nan m/s.*expected finite"),
        (Frame(3, 0.15, PICTURE, Velocity(0, float("inf"))), "w = inf rad/s.*expected finite"),
        (Frame(3, 0.15), "no odometry in the source and no image"),
    ],
)
def test_a_frame_that_cannot_be_used_is_named_and_leaves_the_brain_as_it_was(frame, message):
    brain = seen()
    before = {name: tensor.clone() for name, tensor in brain.state_dict().items()}
    with pytest.raises(BadFrame, match=message):
        brain(frame)
    assert brain.state_dict().keys() == before.keys()
    for name, tensor in brain.state_dict().items():
        assert torch.equal(tensor, before[name]), name
    brain(Frame(4, 0.2, PICTURE, Velocity(0.5, 0.0)))  # and goes on


def test_a_stream_goes_on_after_a_gap_and_after_one_wrong_time():
    brain = seen()
    for index, time_s in ((3, 60.0), (4, 0.2)):  # one wrong time: it is left out
        frame = Frame(index, time_s, PICTURE, Velocity(0.5, 0.0))
        if index == 3:
            with pytest.raises(BadFrame, match="max_gap_s"):
                brain(frame)
        else:
            assert brain(frame).motion.dt_s == pytest.approx(0.1)
    with pytest.raises(BadFrame, match="max_gap_s"):
        brain(Frame(5, 60.0, PICTURE, Velocity(0.5, 0.0)))
    result = brain(Frame(6, 60.05, PICTURE, Velocity(0.5, 0.0)))  # time did pass
    assert result.motion.dt_s == pytest.approx(0.05)


def test_a_picture_of_another_size_is_named():
    brain = NavigationBrain(BrainConfig())
    brain(Frame(0, 0.0, PICTURE))
    with pytest.raises(BadFrame, match=r"frame 1"):
        brain(Frame(1, 0.05, PICTURE[:100]))


@pytest.mark.parametrize(
    "picture", [np.zeros((120, 160), np.uint8), np.full((120, 160), 128, np.uint8)]
)
def test_a_picture_that_shows_nothing_closes_no_loop(picture):
    brain = NavigationBrain(BrainConfig())
    for i in range(600):  # 4.2 laps of the torus: a bound view would be met again
        result = brain(Frame(i, i / 20, picture, Velocity(0.75, 0.0)))
        assert result.action == "none"
    assert (result.n_templates, result.n_experiences, result.n_links) == (0, 0, 0)


def test_odometry_given_or_seen_is_chosen_by_the_config():
    shifted = np.roll(PICTURE, 3, axis=1)
    speeds = {}
    for use in ("auto", "visual"):
        brain = NavigationBrain(BrainConfig(odometry={"use": use}))
        brain(Frame(0, 0.0, PICTURE, Velocity(9.0, 0.0)))
        speeds[use] = brain(Frame(1, 0.05, shifted, Velocity(9.0, 0.0))).motion.v_m_s
    assert speeds["auto"] == 9.0
    assert speeds["visual"] != 9.0
    brain = NavigationBrain(BrainConfig(odometry={"use": "given"}))
    with pytest.raises(BadFrame, match=r"set odometry\.use to 'visual'"):
        brain(Frame(0, 0.0, PICTURE))


def test_every_number_of_the_state_is_in_the_state_dict():
    """What is not a buffer, a table or a known derivative would be lost on the disk."""
    brain = seen()
    derived = {"config", "geometry", "batch", "shape", "torus", "threshold_cells", "training"}
    derived |= {"factor", "threshold", "shift", "columns_per_rad"}  # of the config
    for name, module in brain.named_modules():
        for key, value in vars(module).items():
            if key.startswith("_") or key in derived or dataclasses.is_dataclass(value):
                continue
            if isinstance(value, int | float | np.ndarray):
                saved = brain.state_dict()
                full = f"{name}.{key}"
                counted = key == "n"  # of a table: the length of its columns
                assert full in saved or counted, full
