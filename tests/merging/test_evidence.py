"""What counts as evidence that two maps meet: distinct views, a turn, residuals of odometry."""

import math

import numpy as np
import pytest
import torch

from neuroslam import BrainConfig, NavigationBrain
from neuroslam.geometry import rotate_points
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.merging.candidates import FAR, find_candidates
from neuroslam.merging.consistency import LEAST_TURN_DEG, VIEW_SIGMA_RAD, check_consistency
from neuroslam.merging.limits import spacing_m
from neuroslam.merging.match import find_match
from neuroslam.sensors import open_source
from neuroslam.state.match import Pairs

VIEW = {"template_width": 12, "template_height": 4, "shift_match": 1}


def lived(spec, first=0, last=None, **values):
    brain = NavigationBrain(BrainConfig(**values))
    brain.about = (spec, "", "")
    for frame in open_source(spec, 10.0).frames(first, last):
        brain(frame)
    return brain


# --- the test of the residuals ------------------------------------------------------------------


def drive(rng, places, config, heading_rad=0.0):
    """A map of a drive through places ``(n, 3)``; its odometry errs as the test expects."""
    k, graph = config.sessions.residual_factor, ExperienceMap(config.map)
    pose = np.array([5.0, -3.0, heading_rad])  # a map begins anywhere
    for i in range(len(places)):
        graph.experiences.append(
            pose=torch.from_numpy(pose.copy()), cell=torch.zeros(3).double(),
            template=i, first_frame=i, session=1, number=i,
        )  # fmt: skip
        if i == len(places) - 1:
            break
        ahead = rotate_points((places[i + 1] - places[i])[None, :2], -places[i : i + 1, 2])[0]
        turn = places[i + 1, 2] - places[i, 2]
        ahead += rng.normal(0.0, k * 0.04 * np.linalg.norm(ahead), 2)
        turn += rng.normal(0.0, k * (0.05 * abs(turn) + 0.005))
        graph.links_table.append(
            source=i, target=i + 1, distance_m=math.hypot(*ahead),
            heading_rad=math.atan2(ahead[1], ahead[0]), facing_rad=turn, duration_s=1.0,
        )  # fmt: skip
        pose[:2] += rotate_points(ahead[None], pose[2:])[0]
        pose[2] += turn
    return graph


def arc(n, radius_m=4.0):
    phi = np.linspace(0.0, math.pi, n)
    return np.column_stack([radius_m * np.cos(phi), radius_m * np.sin(phi), phi + math.pi / 2])


def matched(n):
    ids = np.arange(n)
    return Pairs(ids, ids.copy(), np.zeros(n), np.zeros(n))


def test_residuals_of_right_merges_follow_chi_square_and_few_are_refused():
    """The rise has the mean and variance of its degrees of freedom, 3 for each pair but one."""
    config = BrainConfig(sessions={"false_alarm": 0.1})
    cells = config.pose_cells
    aside = [0.5 * cells.create_threshold_cells * cells.cell_size_m] * 2 + [VIEW_SIGMA_RAD]
    rng, n, trials = np.random.default_rng(3), 8, 100
    results = []
    for _ in range(trials):
        places = arc(n)
        one = drive(rng, places, config)
        # The second drive passes the places at some distance and in another heading.
        other = drive(rng, places + rng.normal(0.0, aside, places.shape), config, 2.0)
        results.append(check_consistency(one, other, matched(n), config, robust=False))
    excess, freedom = np.array([result.excess for result in results]), 3 * (n - 1)
    variance = 2.0 * freedom
    assert excess.mean() == pytest.approx(freedom, abs=3.0 * math.sqrt(variance / trials))
    assert excess.var() == pytest.approx(variance, rel=3.0 * math.sqrt(2.0 / trials) + 0.1)
    refused = np.mean([result.excess > result.allowed for result in results])
    assert refused <= 0.1 + 3.0 * math.sqrt(0.09 / trials)


def test_a_wrong_pair_is_left_out_and_the_right_ones_stay():
    rng, config = np.random.default_rng(4), BrainConfig()
    one, other = (drive(rng, arc(12), config, heading) for heading in (0.0, 1.0))
    pairs = matched(12)
    pairs.loaded[8] = 1
    result = check_consistency(one, other, pairs, config, robust=True)
    assert np.flatnonzero(~result.inlier).tolist() == [8]
    assert result.excess <= result.allowed
    forced = check_consistency(one, other, pairs, config, robust=False)
    assert forced.excess > forced.allowed


def test_odometry_whose_own_loops_do_not_close_well_is_trusted_less():
    rng, config = np.random.default_rng(5), BrainConfig()
    one, other = drive(rng, arc(12), config), drive(rng, arc(12), config)
    sure = check_consistency(one, other, matched(12), config, robust=False)
    assert sure.noise == 1.0
    loop = {"source": 11, "target": 0, "heading_rad": 0.0, "duration_s": 1.0}
    other.links_table.append(**loop, distance_m=6.0, facing_rad=-math.pi)  # 8 m and -180 degrees
    unsure = check_consistency(one, other, matched(12), config, robust=False)
    assert unsure.noise > 1.5
    assert unsure.own[0] == pytest.approx(0.0, abs=1e-12)
    assert unsure.own[1] > 10.0


# --- views that are seen elsewhere too ----------------------------------------------------------

SMALL = "&width=96&height=48&noise=0.02"


@pytest.fixture(scope="module")
def few():
    """Maps of two worlds and of another drive through the first, with few templates each."""
    specs = [f"world:{name}?laps=0.7{SMALL}" for name in ("corridor", "ellipse")]
    specs.append(f"{specs[0]}&seed=5&start=0.5")
    return [lived(spec, view={"threshold": 0.15}) for spec in specs]


@pytest.mark.parametrize("which", [(0, 1), (1, 0), (0, 2)])
def test_views_that_match_everywhere_are_no_evidence_and_the_remedy_is_named(which, few):
    one, other = (few[k] for k in which)
    assert one.view.n <= 8
    assert one.map.n > 40
    found = find_match(one, other)
    assert found.match is None
    assert "view.threshold" in found.reason


def test_a_straight_path_alone_is_refused_and_a_bend_asked_for():
    """Along a straight aisle each view has its like, and the distances between them agree."""
    specs = [f"world:corridor?laps=0.22&start=0.88{SMALL}&seed={k}" for k in (1, 2)]
    one, other = (lived(spec) for spec in specs)
    headings = np.unwrap(other.map.poses[:, 2])
    assert math.degrees(np.ptp(headings)) < LEAST_TURN_DEG
    found = find_match(one, other)
    assert found.match is None
    assert "drive through a bend in both sessions" in found.reason
    unchecked = {"sessions": {"check_residuals": False}}
    assert find_match(one, lived(specs[1], **unchecked)).match is not None


def test_of_two_places_with_one_view_neither_is_a_candidate(few):
    one, other = few[0], few[2]
    pairs = find_candidates(one, other).pairs
    views = one.map.experiences["template"].numpy()
    for u in np.unique(pairs.loaded):
        same = one.map.poses[views == views[u], :2]
        assert np.linalg.norm(np.ptp(same, axis=0)) <= FAR * spacing_m(
            (one.map, other.map), one.config
        )
