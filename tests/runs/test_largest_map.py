"""A drive with several maps: the largest is drawn and written, the others are counted."""

import csv
import json

import cv2
import numpy as np
import pytest

from neuroslam import load_brain, open_source
from neuroslam.runs.export import export
from neuroslam.runs.inspect import inspect
from neuroslam.runs.localise import localise
from neuroslam.runs.merge import merge_runs
from neuroslam.runs.run import resolve_config, resume, run
from neuroslam.runs.verify import verify

LONG, SHORT = 120, 30  # frames


def pictures_of(folder, *parts):
    """Pictures of places that do not look alike, with a gap of 100 s after each."""
    folder.mkdir(parents=True)
    time_s = 1.7e9
    for world, n in zip(("corridor", "ellipse", "town"), parts, strict=False):
        spec = f"world:{world}?width=80&height=60&frames_per_lap=150&grey=true"
        for frame in open_source(spec).frames(stop=n):
            time_s = round(time_s + 0.1, 3)
            cv2.imwrite(str(folder / f"{time_s:.3f}.png"), frame.image)
        time_s += 100.0
    return folder


def driven(tmp_path, *parts, stop=None, out="out"):
    if not (tmp_path / "pictures").exists():
        pictures_of(tmp_path / "pictures", *parts)
    config = resolve_config(assignments=("sessions.after_gap=new_map",))
    run(tmp_path / "pictures", tmp_path / out, config, tensorboard=False, stop=stop)
    return tmp_path / out


@pytest.mark.parametrize("parts", [(LONG, SHORT), (SHORT, LONG), (SHORT, LONG, SHORT)])
def test_the_largest_map_is_written_and_the_rest_counted(tmp_path, parts):
    out = driven(tmp_path, *parts)
    brain = load_brain(out / "brain.safetensors")
    largest = brain.largest
    assert largest.map.n == max(m.map.n for m in (brain, *brain.stored)) > 5
    with (out / "experiences.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == largest.map.n
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["experiences"] == largest.map.n
    assert metrics["frames"] == sum(parts)
    assert metrics["frames_on_no_joined_map"] == sum(parts) - LONG
    others = [m["experiences"] for m in metrics["not_joined"]]
    assert len(others) == len(parts) - 1
    assert sum(others) + largest.map.n == sum(m.map.n for m in (brain, *brain.stored))
    track = np.loadtxt(out / "trajectory.tum")
    assert len(track) == LONG
    assert np.isfinite(track).all()
    assert verify(out) == []


def test_what_reads_a_run_reads_its_largest_map(tmp_path):
    out = driven(tmp_path, LONG, SHORT)
    largest = load_brain(out / "brain.safetensors").largest
    export(out, tmp_path / "map.g2o")
    vertices = (tmp_path / "map.g2o").read_text().count("VERTEX")
    assert vertices == largest.map.n
    shown = dict(inspect(out))
    assert shown["experiences"] == str(largest.map.n)
    assert "present map, not joined" in shown
    localise(out, out.parent / "pictures", tmp_path / "poses.csv", stop=LONG)
    with (tmp_path / "poses.csv").open() as file:
        found = [row for row in csv.DictReader(file) if row["found"] == "1"]
    assert len(found) > LONG // 2


def test_a_run_is_resumed_where_the_robot_is_not_on_the_largest_map(tmp_path):
    whole = driven(tmp_path, LONG, SHORT)
    half = driven(tmp_path, stop=LONG + SHORT // 2, out="half")
    resume(half, stop=LONG + SHORT)
    for name in ("experiences.csv", "links.csv", "trajectory.tum", "frames.csv"):
        assert (half / name).read_bytes() == (whole / name).read_bytes()


def test_a_merge_takes_the_largest_map_and_goes_on_where_the_robot_is(tmp_path):
    whole = driven(tmp_path, LONG, SHORT)
    first = driven(tmp_path, stop=LONG, out="first")
    present, known = (load_brain(out / "brain.safetensors") for out in (whole, first))
    assert present.largest is not present
    for pair in ((first, whole), (whole, first)):
        out = tmp_path / pair[0].name / "both"
        summary, reports = merge_runs(*pair, out)
        assert summary is not None, reports[0].reason
        both = load_brain(out / "brain.safetensors")
        assert both.largest.map.n == known.map.n
        goes_on = present if pair[1] == whole else known
        assert (both.map.n, both.clock.frame) == (goes_on.map.n, goes_on.clock.frame)
        assert sorted(one.map.n for one in (both, *both.stored)) == [present.map.n, known.map.n]
        assert verify(out) == []
