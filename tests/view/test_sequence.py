"""A sequence of frames is matched with the stretch of the path that it shows."""

import numpy as np
import pytest

import neuroslam.compiled as switch
from neuroslam.errors import ConfigError, MapError
from neuroslam.view.sequence import SequenceMatcher, best_sequence, line_offsets, sequence_scores


def drive(columns, n, noise=0.0, aliases=0, seed=0):
    """Match errors of frames at given columns of a path: small there and at random aliases."""
    rng = np.random.default_rng(seed)
    errors = 0.3 + noise * rng.standard_normal((len(columns), n))
    for row, column in zip(errors, columns, strict=True):
        row[column] -= 0.1
        row[rng.integers(0, n, aliases)] -= 0.15
    return errors


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, -1.0])
def test_a_drive_at_another_speed_ends_at_its_own_template(ratio):
    columns = (40 + ratio * np.arange(12)).round().astype(int)
    matcher = SequenceMatcher(8, (ratio,))
    for errors in drive(columns, 80):
        match = matcher(errors)
    assert match.template == columns[-1]


def test_ten_frames_find_a_place_that_single_frames_confuse():
    columns = np.arange(20, 70)
    errors = drive(columns, 100, noise=0.03, aliases=3)
    single = (errors.argmin(axis=1) == columns)[10:].mean()
    matcher = SequenceMatcher(10, (1.0,))
    found = np.array([matcher(row).template for row in errors])
    assert single < 0.3
    assert (found == columns)[10:].mean() > 0.9


def test_a_path_that_looks_the_same_twice_has_a_runner_up_as_good_as_the_best():
    once = drive(np.arange(10, 30), 40, noise=0.02)
    matcher = SequenceMatcher(10, (1.0,))
    for row in np.hstack([once, once]):
        twice = matcher(row)
    alone = SequenceMatcher(10, (1.0,))
    for row in once:
        match = alone(row)
    assert twice.ratio == pytest.approx(1.0)
    assert match.ratio < 0.6


def test_the_order_of_frames_matters():
    matcher = SequenceMatcher(10, (1.0,))
    forward = [matcher(row).score for row in drive(np.arange(20, 40), 60)][-1]
    matcher.forget()
    backward = [matcher(row).score for row in drive(np.arange(40, 20, -1), 60)][-1]
    assert forward < 3 * backward


def test_a_scale_or_an_offset_of_a_frame_changes_nothing():
    rows = drive(np.arange(10, 20), 40, noise=0.02)
    one, other = SequenceMatcher(5, (0.8, 1.0)), SequenceMatcher(5, (0.8, 1.0))
    for i, row in enumerate(rows):
        np.testing.assert_allclose(one.scores(row), other.scores((1 + i) * row + i), atol=1e-9)


@pytest.mark.parametrize("enabled", [True, False])
def test_templates_that_are_added_later_and_frames_without_a_view_are_left_out(
    enabled, monkeypatch
):
    monkeypatch.setattr(switch, "ENABLED", enabled)
    matcher = SequenceMatcher(4, (1.0,))
    matcher(drive([10], 30)[0])
    matcher(np.full(30, np.nan))
    match = matcher(drive([12], 33)[0])
    assert match.template == 12
    scores = matcher.scores(drive([13], 36)[0])
    assert np.isfinite(scores[2:30]).all()
    assert np.isinf(scores[35])  # one of three frames, less than half


def test_a_path_is_not_scored_where_it_was_before_the_first_template():
    offsets = line_offsets(6, (1.0,))
    scores = sequence_scores(np.zeros((6, 10)), offsets)
    assert np.isinf(scores[:2]).all()
    assert np.isfinite(scores[2:]).all()


def test_nothing_to_compare_is_no_match():
    assert best_sequence(np.empty(0)).template == -1
    assert SequenceMatcher(3)(np.full(4, np.nan)).template == -1
    assert SequenceMatcher(3)(np.full(4, 0.2)).ratio == 1.0


def test_the_runner_up_can_be_limited_to_given_templates():
    scores = np.array([-3.0, -1.0, -2.0, -1.5])
    near = np.array([True, False, True, False])
    assert best_sequence(scores, near).runner_up == -1.5


def test_a_matcher_goes_on_from_its_state_bit_for_bit():
    rows = drive(np.arange(10, 30), 50, noise=0.05)
    one, other = SequenceMatcher(), SequenceMatcher()
    for row in rows[:7]:
        one(row)
    other.load_state_dict(one.state_dict())
    for row in rows[7:]:
        assert one(row) == other(row)


def test_wrong_settings_and_fewer_templates_are_refused():
    with pytest.raises(ConfigError, match="length 0"):
        SequenceMatcher(0)
    with pytest.raises(ConfigError, match="finite ratios"):
        SequenceMatcher(3, ())
    matcher = SequenceMatcher(3)
    matcher(np.zeros(4))
    with pytest.raises(MapError, match="3 match errors, 4 before"):
        matcher(np.zeros(3))
