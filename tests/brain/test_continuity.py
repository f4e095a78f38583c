"""A kidnapping comes out of calm; a bump builds up, and a drive of small changes has neither."""

import numpy as np
import pytest
import torch

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.brain.continuity import Continuity
from neuroslam.config import BrainConfig
from neuroslam.state.files import save_checked

CONFIG = BrainConfig(view={"template_width": 20, "template_height": 10, "threshold": 0.05})


def driven(changes, seed=0):
    """Compare views that differ by given amounts, after a calm drive; return what is broken."""
    rng = np.random.default_rng(seed)
    continuity = Continuity(CONFIG)
    view = rng.uniform(0.3, 0.7, (10, 20))
    found = []
    for change in [0.01] * 60 + list(changes):
        view = view + change * rng.choice((-1.0, 1.0), view.shape)
        view = np.where((view < 0.0) | (view > 1.0), 0.5, view)
        found.append(continuity.compare(view).broken)
    return found[60:]


def test_a_cut_out_of_calm_is_broken():
    assert driven([0.01, 0.3, 0.01, 0.01]) == [False, True, False, False]


def test_a_bump_that_builds_up_is_not():
    assert not any(driven([0.03, 0.05, 0.08, 0.12, 0.16, 0.12, 0.06, 0.02]))


def test_a_cut_is_noticed_again_once_a_bump_is_over():
    assert driven([0.03, 0.06, 0.1, 0.06, *[0.01] * 12, 0.3])[-1]


@pytest.mark.parametrize("seed", range(3))
def test_one_jolt_is_one_alarm(seed):
    assert sum(driven([0.3, 0.35, 0.3, 0.01], seed)) == 1


def test_a_brain_of_format_6_is_loaded_as_after_a_calm_drive(tmp_path):
    brain = NavigationBrain(CONFIG)
    brain.continuity.state.usual = 0.02
    state = brain.state_dict()
    del state["continuity.state.recent"]
    about = {"format": 6, "config": brain.config.model_dump(mode="json")}
    save_checked(tmp_path / "old", about, state)
    loaded = load_brain(tmp_path / "old")
    assert loaded.continuity.state.recent == 0.0
    assert loaded.continuity.state.usual == 0.02
    assert torch.equal(loaded.continuity.before, brain.continuity.before)
