"""Heights of a run in its files, its exports and its evaluation."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from neuroslam import load_brain
from neuroslam.config import build_config, read_preset
from neuroslam.evaluation.trajectory import Track, read_tum, write_tum
from neuroslam.runs.evaluate import evaluate
from neuroslam.runs.export import export
from neuroslam.runs.heights import frame_heights, map_heights, rises_of_links
from neuroslam.runs.inspect import inspect
from neuroslam.runs.reading import read_frames, read_trace
from neuroslam.runs.run import run
from neuroslam.runs.verify import verify
from neuroslam.worlds.world import open_world

SPEC = "world:garage?grey=true&rate=5&frames_per_lap=950&start=0.15&laps=0.13"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive up the first ramp, and its brain."""
    out = tmp_path_factory.mktemp("ramp") / "run"
    run(SPEC, out, build_config(read_preset("neuroslam_3d")))
    return out, load_brain(out / "brain.safetensors")


def test_the_trajectory_has_the_height_of_every_frame(drive):
    out, brain = drive
    track = read_tum(out / "trajectory.tum")
    truth = open_world(SPEC).heights()
    assert track.heights_m is not None
    rise = track.heights_m - truth + truth[0]
    assert np.abs(rise).max() < 0.05
    on_map = frame_heights(brain, read_trace(out), out)
    np.testing.assert_allclose(track.heights_m, on_map, atol=1e-9)
    assert read_frames(out)["z_m"][-1] == pytest.approx(on_map[-1], abs=1e-6)
    assert list(verify(out)) == []


def test_a_wrong_height_in_a_trajectory_is_found(drive, tmp_path):
    import shutil

    copy = tmp_path / "run"
    shutil.copytree(drive[0], copy)
    track = read_tum(copy / "trajectory.tum")
    up = track.heights_m.copy()
    up[5] += 0.1
    write_tum(copy / "trajectory.tum", track._replace(heights_m=up))
    assert any("trajectory.tum" in fault for fault in verify(copy))


def test_tum_files_keep_heights_and_those_of_the_plane_have_none(tmp_path):
    track = Track(np.arange(3.0), np.zeros((3, 3)), np.array([0.0, 1.25, -2.0]))
    write_tum(tmp_path / "a.tum", track)
    np.testing.assert_array_equal(read_tum(tmp_path / "a.tum").heights_m, track.heights_m)
    write_tum(tmp_path / "b.tum", track._replace(heights_m=None))
    assert read_tum(tmp_path / "b.tum").heights_m is None
    assert " 0 0 0 0.0" in (tmp_path / "b.tum").read_text()


def test_a_brain_exports_the_heights_of_its_experiences(drive, tmp_path):
    out, brain = drive
    heights = map_heights(brain)
    export(out / "brain.safetensors", tmp_path / "map.tum")
    np.testing.assert_allclose(read_tum(tmp_path / "map.tum").heights_m, heights, atol=1e-9)


def test_g2o_is_a_graph_of_upright_poses(drive, tmp_path):
    out, brain = drive
    export(out, tmp_path / "map.g2o")
    lines = [line.split() for line in (tmp_path / "map.g2o").read_text().splitlines()]
    vertices = np.array([line[1:] for line in lines if line[0] == "VERTEX_SE3:QUAT"], float)
    np.testing.assert_array_equal(vertices[:, 3], map_heights(brain))
    heading = 2.0 * np.arctan2(vertices[:, 6], vertices[:, 7])
    np.testing.assert_allclose(np.cos(heading), np.cos(brain.map.poses[:, 2]), atol=1e-12)
    edges = np.array([line[1:] for line in lines if line[0] == "EDGE_SE3:QUAT"], float)
    assert edges.shape == (brain.map.n_links, 2 + 7 + 21)
    np.testing.assert_array_equal(edges[:, 4], rises_of_links(brain, map_heights(brain)))
    assert lines[-1] == ["FIX", "0"]


def test_graphml_has_heights_and_rises(drive, tmp_path):
    out, brain = drive
    export(out, tmp_path / "map.graphml")
    root = ElementTree.parse(tmp_path / "map.graphml").getroot()
    name = "{http://graphml.graphdrawing.org/xmlns}"
    found = {
        key: [float(one.text) for one in root.iter(f"{name}data") if one.get("key") == key]
        for key in ("z_m", "rise_m")
    }
    assert found["z_m"] == map_heights(brain).tolist()
    assert len(found["rise_m"]) == brain.map.n_links


def test_the_evaluation_is_in_three_dimensions_where_both_have_heights(drive, tmp_path):
    out, _ = drive
    source = open_world(SPEC)
    times, truth = np.arange(source.n_frames) / 5.0, source.truths()
    write_tum(tmp_path / "truth.tum", Track(times, truth, source.heights()))
    rows = {name: error for name, error, _ in evaluate(out, tmp_path / "truth.tum")}
    assert rows["absolute in x, y, z"].rmse == pytest.approx(
        math.hypot(rows["absolute (ATE)"].rmse, 0.0), abs=0.05
    )
    raised = source.heights() * 1.5
    write_tum(tmp_path / "steep.tum", Track(times, truth, raised))
    steep = {name: error for name, error, _ in evaluate(out, tmp_path / "steep.tum")}
    assert steep["absolute in x, y, z"].rmse > rows["absolute in x, y, z"].rmse + 0.2
    write_tum(tmp_path / "flat.tum", Track(times, truth))
    names = [name for name, *_ in evaluate(out, tmp_path / "flat.tum")]
    assert "absolute in x, y, z" not in names


def test_inspect_says_how_high_the_map_is(drive):
    rows = dict(inspect(drive[0]))
    assert float(rows["height range"].split()[0]) == pytest.approx(2.7, abs=0.2)


def test_mcap_has_heights(drive, tmp_path):
    pytest.importorskip("mcap")
    from mcap.reader import make_reader

    out, brain = drive
    export(out, tmp_path / "run.mcap")
    with (tmp_path / "run.mcap").open("rb") as file:
        poses = [m.data for _, c, m in make_reader(file).iter_messages(topics=["/pose"])]
    up = [np.frombuffer(data[-40:-32], "<f8")[0] for data in poses]
    np.testing.assert_allclose(up, frame_heights(brain, read_trace(out), out), atol=1e-9)
