"""The parts of the experiment ``live-fleet``, on a few frames."""

from itertools import islice

import numpy as np
import pytest

from neuroslam import BrainConfig, open_source
from neuroslam.experiments import live_fleet as experiment
from neuroslam.shared_map.fold import gather

RING = "world:ellipse?width=128&height=32&frames_per_lap=200"


def test_a_robot_of_the_experiment_offers_every_place_that_it_makes():
    frames = islice(open_source(RING).frames(), 25)
    done = experiment.drive(frames, BrainConfig(), "ada")
    records = gather(done.entries)
    assert len(records.places) == done.run.brain.map.n == len(done.made)
    assert len(done.entries) == 3  # after two seconds and at the end
    assert (np.diff(done.made[:, 0]) >= 0.0).all()
    assert len(records.links) == done.run.brain.map.n_links


@pytest.mark.parametrize("fault", experiment.FAULTS.values(), ids=list(experiment.FAULTS))
def test_a_fault_changes_the_odometry_alone(fault):
    frames = list(islice(open_source(RING).frames(), 3))
    for before, after in zip(frames, experiment.spoilt(iter(frames), fault), strict=True):
        v, w = before.velocity
        assert after.velocity == (v * fault[0], w * fault[1] + fault[2])
        assert after.image is before.image


def test_every_fault_of_the_experiment_is_one():
    assert all(fault != (1.0, 1.0, 0.0) for fault in experiment.FAULTS.values())
