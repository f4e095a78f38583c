import json

import numpy as np
import pytest

from neuroslam.experiments import head_direction as experiment
from neuroslam.experiments import run_experiment


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out = tmp_path_factory.mktemp("heads")
    results = experiment.head_direction(None, out, minutes=1.0, n_animals=8)
    return out, results, {row["quantity"]: row["value"] for row in results["rows"]}


def test_it_writes_its_rows_and_its_figures(measured):
    out, results, _ = measured
    assert json.loads((out / "results.json").read_text()) == results
    pictures = {path.name for path in out.glob("*.png")}
    assert pictures == {
        "tuning.png", "turning.png", "cues.png", "drift.png", "persistence.png", "speed_cells.png"
    }  # fmt: skip


def test_the_results_are_those_of_the_docs(measured):
    value = measured[2]
    assert value["tuning_width_at_half_height_deg"] == pytest.approx(46.05, abs=0.01)
    assert value["tuning_width_at_2_percent_deg"] == pytest.approx(99.08, abs=0.01)
    assert value["largest_error_of_integration_deg"] < 1e-6
    assert value["drift_without_cues_off_the_noise_deg"] < 1e-6
    assert value["moved_without_input_deg"] < 1e-9
    assert value["cue_40_deg_for_5_s_time_between_s"] > 0.3
    assert value["cue_140_deg_for_5_s_time_between_s"] == 0.0
    assert value["error_with_compass_rms_deg"] < 3.0
    assert 0.05 <= value["speed_ahead_s"] <= 0.08


def test_the_filter_of_a_noiseless_compass_leaves_the_share_it_has_not_corrected():
    assert experiment.filtered_sd(0.0, 1.0, 1e9) == pytest.approx(0.0, abs=1e-4)
    # A compass that corrects at once leaves its own noise, and nothing of the walk.
    assert experiment.filtered_sd(5.0, 1.0, 1e-6) == pytest.approx(1.0)


def test_it_is_among_the_experiments(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        experiment, "head_direction", lambda data, out: asked.append((data, out)) or {"rows": []}
    )
    assert run_experiment("head-direction", None, tmp_path) == []
    assert asked == [(None, tmp_path)]


def test_turns_are_as_fast_as_they_are_said_to_be():
    rates = experiment.turns(200.0, 20, seed=0)
    assert np.degrees(rates.std()) == pytest.approx(80.0, rel=0.1)
