"""Views compared by regions: what they forgive, and what counts for nothing."""

import cv2
import numpy as np
import pytest
import torch

from neuroslam.errors import MapError
from neuroslam.state.join import Join
from neuroslam.view.regions import RegionMatcher, region_errors, regions_of, whitening

N = 12


def picture(seed, aside=0):
    """A far wall, and a near box that moves three times as far when the robot drives beside."""
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(60, 160, (9, 14), np.uint8), (200, 120))
    box = cv2.resize(rng.integers(0, 255, (5, 5), np.uint8), (50, 60))
    image = wall[:, 20 + aside : 180 + aside].copy()
    image[40:100, 55 - 3 * aside : 105 - 3 * aside] = box
    return image


def learnt(n=N):
    matcher = RegionMatcher()
    for seed in range(n):
        matcher.learn(picture(seed))
    return matcher


def found(matcher, change):
    return [int(matcher(change(seed)).argmin()) for seed in range(N)]


def test_a_place_is_found_from_beside_in_less_light_and_behind_a_border():
    def other(seed):
        image = (0.5 * picture(seed, aside=8)).astype(np.uint8) + 10
        image[:, :25] = 0
        return image

    assert found(learnt(), other) == list(range(N))


def test_a_structure_that_is_everywhere_does_not_count():
    alike = np.full((5, 3), 0.2)
    alike[:, 0] = 0.9  # a region that every view has
    alike[3, 1] = 0.7
    errors = region_errors(alike)
    assert errors.argmin() == 3
    assert errors[3] == pytest.approx(1.0 - 0.5 / 3.0)
    assert np.delete(errors, 3) == pytest.approx(1.0)


def test_whitened_regions_of_the_map_have_no_common_direction():
    cells = np.random.default_rng(0).random((6, 14, 18, 8)).astype(np.float32)
    cells[..., 1:] += cells[..., :1]  # all directions rise and fall together
    regions = regions_of(cells).reshape(-1, 72)
    mean, basis = whitening(regions, 20)
    covariance = np.cov(((regions - mean) @ basis).T)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-3
    assert np.diag(covariance).max() <= 1.0 + 1e-5


def test_its_state_is_that_of_the_views_and_merges_to_all_of_them():
    one, other = learnt(), RegionMatcher()
    other.load_state_dict(one.state_dict())
    image = picture(3, aside=3)
    assert np.array_equal(one(image), other(image))
    both = RegionMatcher()
    state = one.state_dict()
    half = [{name: rows[part] for name, rows in state.items()} for part in (slice(5), slice(5, N))]
    both.load_state_dict(both.merged(*half, Join.nothing()))
    assert torch.equal(both.views["cells"], one.views["cells"])
    changed = learnt()
    changed.load_state_dict(learnt(N - 1).state_dict() | {"views.cells": state["views.cells"][1:]})
    assert len(changed(image)) == N - 1


def test_views_that_are_replaced_by_as_many_others_are_compared():
    matcher = learnt()
    before = matcher(picture(3))
    state = matcher.state_dict()
    matcher.load_state_dict({"views.cells": state["views.cells"].flip(0)})
    assert matcher(picture(3)) == pytest.approx(before[::-1], abs=1e-5)


def test_without_a_stored_view_it_says_what_to_do():
    with pytest.raises(MapError, match=r"call learn\(\)"):
        RegionMatcher()(picture(0))
    assert RegionMatcher().n == 0
    assert region_errors(np.empty((0, 3))).shape == (0,)
    assert learnt(1)(picture(0)).tolist() == [1.0]
