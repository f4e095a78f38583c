"""Drift of odometry by profiles, flow and wheels."""

import numpy as np
import pytest

from neuroslam.errors import RunError
from neuroslam.experiments.odometry_drift import METHODS, Motions, _rows_of_drive, odometry_drift


def test_flow_turns_as_the_world_does_and_writes_rows_and_a_figure(tmp_path):
    rows = odometry_drift(None, tmp_path, worlds=("corridor",), frames=60)["rows"]
    assert [row["method"] for row in rows] == list(METHODS)
    by = {row["method"]: row for row in rows}
    assert by["flow"]["turn_rms_deg"] < 0.2 < by["profiles"]["turn_rms_deg"]
    assert by["wheels"]["ms"] < by["profiles"]["ms"] < by["flow"]["ms"]
    assert {path.name for path in tmp_path.iterdir()} == {"results.json", "odometry_drift.png"}


def test_laps_of_one_track_that_turn_alike_do_not_vary():
    dt, laps = np.full(400, 0.1), np.arange(401) / 100.0
    steady = np.stack([np.full(400, 2.0), np.full(400, 0.3)], axis=-1)
    uneven = steady * np.where(np.arange(400) < 200, 1.0, 2.0)[:, None]
    rows = list(
        _rows_of_drive("d", Motions(dt, np.stack([steady, uneven]), np.ones(2), None), laps)
    )
    assert rows[0]["turn_of_a_lap_deg"] == pytest.approx(np.degrees(3.0))
    assert rows[0]["turn_varies_percent"] == pytest.approx(0.0, abs=1e-9)
    assert rows[1]["length_varies_percent"] > 20.0


def test_a_drive_without_laps_is_refused(tmp_path):
    with pytest.raises(RunError, match=r"expected frames\.tar and laps\.csv"):
        odometry_drift(tmp_path, tmp_path / "out", worlds=(), drives=("none",))
