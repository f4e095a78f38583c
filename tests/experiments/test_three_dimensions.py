"""Height given and seen beside none, on one short drive."""

import json

from neuroslam.experiments.three_dimensions import config_of, methods_of, three_dimensions


def test_a_drive_is_measured_with_the_height_given_and_seen_and_without(tmp_path):
    result = three_dimensions(None, tmp_path, drives=1, flights=0, looks=(0,), frames=420)
    given, seen, plane = rows = result["rows"]
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == rows
    assert [row["height"] for row in rows] == methods_of("garage") == ["given", "seen", "plane"]
    assert given["drives_confused"] == given["links_between_storeys"] == 0
    assert plane["drives_confused"] == 1
    assert given["ate_3d_median_m"] < given["odometry_ate_3d_median_m"]
    assert seen["height_rmse_median_m"] < plane["height_rmse_median_m"]
    assert (tmp_path / "three_dimensions.png").stat().st_size > 10_000


def test_what_is_seen_depends_on_the_vehicle():
    assert config_of("seen", "garage").odometry.climb == "pitch"
    assert config_of("seen", "atrium").odometry.climb == "slope"
    assert config_of("given", "atrium").odometry.climb == "given"
    assert methods_of("atrium") == ["given", "seen", "rows", "plane"]
