"""The activity of cells is recorded densely, streams to disk, and goes into others' formats."""

import json
import os

import numpy as np
import pytest

from neuroslam import ActivityLog, NavigationBrain, open_source, record
from neuroslam.cells.speed import SpeedCells
from neuroslam.config import build_config, read_preset
from neuroslam.errors import CheckpointError, ConfigError, RunError
from neuroslam.runs.activity import parse_record
from neuroslam.runs.run import resume, run
from neuroslam.runs.verify import verify
from neuroslam.state.activity_writer import ActivityWriter
from neuroslam.state.arrays import ROWS, ArrayFolder, read_array
from neuroslam.types import Frame, Motion, Pose, PoseEstimate, StepResult, ViewMatch

WALK = "arena:square?minutes=0.6&speed=0.2"


@pytest.fixture(scope="module")
def log():
    return record(WALK)


def test_a_log_has_every_cell_at_every_sample_in_a_fixed_order(log):
    brain, rows, places = NavigationBrain(build_config(read_preset("slrb"))), [], []
    for frame in open_source(WALK):
        brain(frame)
        rows.append(brain.navigation.grid.rates.flatten().numpy().copy())
        places.append(int(brain.navigation.place.n_cells))
    np.testing.assert_array_equal(log["grid"], rows)
    assert log["place"].shape == (len(rows), places[-1])
    for cell in range(places[-1]):  # 0 before it was recruited, and active then
        first = next(i for i, n in enumerate(places) if n > cell)
        assert not log["place"][:first, cell].any()
        assert log["place"][first, cell] == pytest.approx(1.0, abs=1e-4)
    assert log.has_truth
    assert np.hypot(*(log.position_m - log.position_m[0] - log.estimate_m).T).max() < 0.3
    assert log.cells["boundary"]["bearing_rad"].shape == (log["boundary"].shape[1],)


def test_a_log_on_disk_is_that_in_memory(log, tmp_path):
    on_disk = record(WALK, out=tmp_path / "log")
    assert on_disk.names == log.names == ("boundary", "grid", "place")
    for name in log.names:
        np.testing.assert_array_equal(on_disk[name], log[name])
        for column, values in log.cells[name].items():
            np.testing.assert_array_equal(on_disk.cells[name][column], values)
    for column in ("time_s", "frame", "truth_m", "truth_heading_rad", "estimate_m", "speed_m_s"):
        np.testing.assert_array_equal(getattr(on_disk, column), getattr(log, column))
    with pytest.raises(ConfigError, match="is not empty"):
        record(WALK, out=tmp_path / "log")


def _result(frame, time_s):
    nothing = ViewMatch(-1, -1.0, 0.0, False)
    motion, pose = Motion(0.1, 0.0, 0.05), Pose(0.0, 0.0, 0.0)
    return StepResult(
        frame, time_s, motion, nothing, "none", -1, pose, PoseEstimate(0, 0, 0), 0, 0, 0
    )


@pytest.mark.parametrize(
    ("frames_hz", "rate_hz", "taken"), [(20, 20, 101), (20, 5, 26), (5, 20, 26)]
)
def test_samples_are_taken_at_the_rate_and_at_most_once_a_frame(frames_hz, rate_hz, taken):
    writer = ActivityWriter(None, rate_hz)
    for k in range(5 * frames_hz + 1):
        writer.note(_result(k, 7.0 + k / frames_hz), Frame(k, 7.0 + k / frames_hz), {})
    assert writer.log().n_samples == taken


def test_rows_after_the_last_that_is_counted_are_zero_when_written_again(tmp_path):
    folder = ArrayFolder(tmp_path / "a", {})
    table = np.arange(1.0, 6 * (ROWS + 41) + 1.0, dtype=np.float32).reshape(-1, 6)
    folder.append(0, {"grid": table})
    again = ArrayFolder.reopen(tmp_path / "a", ROWS - 10)  # as after a kill
    again.append(ROWS - 10, {"other": np.ones((50, 3), np.float32)})
    whole = read_array(tmp_path / "a", "grid")
    np.testing.assert_array_equal(whole[: ROWS - 10], table[: ROWS - 10])
    assert whole.shape == (ROWS + 40, 6)
    assert not whole[ROWS - 10 :].any()
    np.testing.assert_array_equal(read_array(tmp_path / "a", "other")[:, 0], [0] * 502 + [1] * 50)


def test_a_resumed_run_has_the_log_of_one_that_never_stopped(log, tmp_path):
    config = build_config(read_preset("slrb"))
    run(WALK, tmp_path / "run", config, record=["grid", "place"], tensorboard=False, stop=300)
    # A killed run has written more rows than the brain has seen at its last save.
    late = ActivityWriter.reopen(tmp_path / "run" / "activity.zarr", 299)
    late.note(_result(300, 1e3), Frame(300, 1e3), {})
    late.flush()
    assert ActivityLog.open(tmp_path / "run").n_samples == 301
    resume(tmp_path / "run", tensorboard=False)
    again = ActivityLog.open(tmp_path / "run")
    assert again.names == ("grid", "place")
    for name in again.names:
        np.testing.assert_array_equal(again[name], log[name])
    run(WALK, tmp_path / "run", config, overwrite=True, tensorboard=False, stop=20)
    assert not (tmp_path / "run" / "activity.zarr").exists()


def test_a_damaged_log_is_refused_in_one_line(tmp_path):
    with pytest.raises(CheckpointError, match="no recorded activity"):
        ActivityLog.open(tmp_path)
    record("arena:square?minutes=0.02", out=tmp_path / "log", only=["grid"])
    block = tmp_path / "log" / "grid" / "0.0"
    block.write_bytes(block.read_bytes()[:100])
    with pytest.raises(CheckpointError, match="grid: damaged"):
        ActivityLog.open(tmp_path / "log")
    about = json.loads((tmp_path / "log" / "grid" / ".zarray").read_text())
    about["shape"][0] = 10**13
    (tmp_path / "log" / "grid" / ".zarray").write_text(json.dumps(about))
    with pytest.raises(CheckpointError, match=r"log/(grid|time_s)"):
        read_array(tmp_path / "log", "grid")


def test_what_to_record_is_checked():
    assert parse_record("cells=grid, place") == ("grid", "place")
    for wrong in ("cell", "cells=", "grid"):
        with pytest.raises(RunError, match="expected cells, or cells=POPULATION"):
            parse_record(wrong)
    with pytest.raises(ConfigError, match=r"no population 'gird'.*boundary, grid, place"):
        record("arena:square?minutes=0.02", only=["gird"])
    with pytest.raises(ConfigError, match="recorded are: grid"):
        record("arena:square?minutes=0.02", only=["grid"])["place"]


def test_spikes_have_the_rates_and_follow_from_the_seed():
    n = 20_000
    rates = np.tile(np.array([0.0, 5.0, 20.0]), (n, 1))
    log = ActivityLog.from_arrays(
        np.arange(n) / 20.0, np.zeros((n, 2)), {"speed": rates}, units={"speed": "Hz"}
    )
    spikes = log.spikes("speed", seed=3)
    counts = np.bincount(spikes.cells, minlength=3) / (n / 20.0)
    assert counts[0] == 0.0
    np.testing.assert_allclose(counts[1:], [5.0, 20.0], rtol=0.05)  # 1 / sqrt(5000) is 1.4 %
    assert (np.diff(spikes.times_s) >= 0.0).all()
    np.testing.assert_array_equal(spikes.times_s, log.spikes("speed", seed=3).times_s)
    assert len(log.spikes("speed", seed=4).times_s) != len(spikes.times_s)
    relative = ActivityLog.from_arrays(log.time_s, np.zeros((n, 2)), {"place": rates / 100.0})
    most = np.bincount(relative.spikes("place", peak_hz=8.0).cells)[2] / (n / 20.0)
    assert most == pytest.approx(8.0, rel=0.05)


def test_units_are_those_of_the_population():
    config = build_config(read_preset("slrb") | {"cells": "place+speed+head_direction"})
    log = record("arena:square?minutes=0.05", config)
    assert log.units["speed"] == "Hz"
    assert log.units["head_direction"] == "1"
    assert log["speed"].shape[1] == SpeedCells().config.n
    assert log.cells["head_direction"]["preferred_rad"].shape == (log["head_direction"].shape[1],)


def test_xarray_and_pynapple_have_all_of_it(log):
    pytest.importorskip("xarray")
    nap = pytest.importorskip("pynapple")
    data = log.to_xarray()
    np.testing.assert_array_equal(data["grid"].sel(time=1.0), log["grid"][20])
    assert data["place"].attrs["units"] == "1"
    assert data["boundary_bearing_rad"].dims == ("boundary_cell",)
    series = log.to_pynapple()
    np.testing.assert_array_equal(series["place"].values, log["place"])
    np.testing.assert_allclose(series["position"].values, log.position_m)
    turning = nap.compute_tuning_curves(
        series["grid"], series["position"], bins=(5, 5), return_pandas=False
    )
    assert np.isfinite(turning.values).any()


@pytest.mark.filterwarnings("ignore:.*have no duration:UserWarning")  # cells with one spike
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_an_nwb_file_has_nothing_to_mend_and_comes_back(log, tmp_path):
    pytest.importorskip("pynwb")
    nap = pytest.importorskip("pynapple")
    inspector = pytest.importorskip("nwbinspector")
    path = log.to_nwb(tmp_path / "rat.nwb", spikes=["place"])
    grave = [
        message
        for message in inspector.inspect_nwbfile(nwbfile_path=path, skip_validate=True)
        if message.importance.name in ("CRITICAL", "BEST_PRACTICE_VIOLATION", "ERROR")
    ]
    assert not grave, grave
    file = nap.load_file(str(path))
    np.testing.assert_allclose(file["position"].values, log.position_m, atol=1e-6)
    np.testing.assert_allclose(file["grid"].values, log["grid"], atol=1e-6)
    np.testing.assert_allclose(file["grid"].times(), log.time_s, atol=1e-6)
    assert len(file["units"]) == len(np.unique(log.spikes("place").cells))
    file.close()


def _edit(path, change):
    about = json.loads(path.read_text())
    change(about)
    path.write_text(json.dumps(about))


FAULTS = {
    "rows": (".zarray", lambda a: a["shape"].__setitem__(0, -3), "damaged"),
    "no shape": (".zarray", lambda a: a.pop("shape"), "damaged"),
    "rows of a text": (".zarray", lambda a: a.update(shape="ab"), "damaged"),
    "objects": (".zarray", lambda a: a.update(dtype="|O"), "damaged"),
    "no dtype": (".zarray", lambda a: a.update(dtype="((("), "damaged"),
    "blocks of none": (".zarray", lambda a: a.update(chunks=[512, 0]), "damaged"),
    "small blocks": (".zarray", lambda a: a.update(chunks=[1, 1]), "damaged"),
    "billions of columns": (".zarray", lambda a: a["shape"].__setitem__(1, 10**13), "see --max"),
    "cells of a text": (".zattrs", lambda a: a.update(cells="x"), "damaged"),
    "cells of nothing": (".zattrs", lambda a: a.update(cells={"x": [None, 1]}), "no column of"),
    "deep": (".zattrs", lambda a: None, "nested too deeply"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_a_log_says_of_itself_is_checked(fault, tmp_path):
    name, change, message = FAULTS[fault]
    record("arena:square?minutes=0.02", out=tmp_path / "log", only=["grid"])
    file = tmp_path / "log" / "grid" / name
    _edit(file, change)
    if fault == "deep":
        file.write_text('{"a":' * 100_000)
    with pytest.raises(CheckpointError, match=message) as caught:
        ActivityLog.open(tmp_path / "log")
    assert "\n" not in str(caught.value)


def test_a_log_of_few_blocks_is_read_at_once_and_a_pipe_is_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUROSLAM_MAX_MEMORY", "1G")
    folder = ArrayFolder(tmp_path / "a", {})
    folder.append(0, {"x": np.ones((3, 1), np.uint8)})
    _edit(tmp_path / "a" / "x" / ".zarray", lambda a: a.update(shape=[10**5, 5000], chunks=[1, 1]))
    with pytest.raises(CheckpointError, match=r"block 0\.0; expected 1 bytes"):
        read_array(tmp_path / "a", "x")  # not half a billion blocks that are not there
    (tmp_path / "a" / "x" / "0.0").write_bytes(b"\x07")
    assert read_array(tmp_path / "a", "x").sum() == 7
    (tmp_path / "a" / "x" / "0.0").unlink()
    os.mkfifo(tmp_path / "a" / "x" / "0.0")
    with pytest.raises(CheckpointError, match="is a device or a pipe"):
        read_array(tmp_path / "a", "x")


def test_a_finished_run_has_a_digest_of_its_log_which_rows_after_it_do_not_change(tmp_path):
    config, out = build_config(read_preset("slrb")), tmp_path / "run"
    run(WALK, out, config, record=["grid"], tensorboard=False, stop=100)
    assert json.loads((out / "manifest.json").read_text())["files"]["activity.zarr"]["rows"] == 100
    late = ActivityWriter.reopen(out / "activity.zarr", 99)
    late.note(_result(100, 1e3), Frame(100, 1e3), {})
    late.flush()
    assert verify(out) == []
    block = out / "activity.zarr" / "grid" / "0.0"
    data = bytearray(block.read_bytes())
    data[1000] ^= 4
    block.write_bytes(data)
    assert len(verify(out)) == 1
    assert "activity.zarr: differs from what was saved" in verify(out)[0]
