"""Pose cells in 3-D beside those of the plane, on one short drive."""

import json

from neuroslam.experiments.three_dimensions import three_dimensions


def test_a_drive_is_measured_by_both_kinds_of_cells(tmp_path):
    result = three_dimensions(None, tmp_path, drives=1, flights=0, looks=(0,), frames=420)
    space, plane = result["rows"]
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == [space, plane]
    assert (space["cells"], plane["cells"]) == ("pose_3d", "pose")
    assert space["drives_confused"] == space["links_between_storeys"] == 0
    assert plane["drives_confused"] == 1
    assert space["ate_3d_median_m"] < space["odometry_ate_3d_median_m"]
    assert (tmp_path / "three_dimensions.png").stat().st_size > 10_000
