"""A run as an MCAP file: it is opened again by the reader of MCAP itself."""

import base64
import json

import cv2
import numpy as np
import pytest

from neuroslam.brain import load_brain
from neuroslam.cli import main
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.runs.mcap import CELLS_EVERY, TOPICS

FRAMES = 55


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    pytest.importorskip("mcap", reason="needs the extra mcap")
    from mcap.reader import make_reader

    folder = tmp_path_factory.mktemp("mcap")
    source = f"world:corridor?width=64&height=40&frames_per_lap={FRAMES - 1}&laps=1"
    words = [source, "-o", str(folder / "run"), "--preset", "ratslam", "--no-tensorboard"]
    assert main(["run", *words, "--mcap", str(folder / "run.mcap")]) == 0
    messages, schemas = {topic: [] for topic in TOPICS}, {}
    with (folder / "run.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            messages[channel.topic].append((message.log_time, json.loads(message.data)))
            schemas[channel.topic] = schema.name
            assert json.loads(schema.data)["type"] == "object"
    return folder / "run", messages, schemas


def test_every_channel_has_its_schema_and_all_its_messages(recorded):
    _, messages, schemas = recorded
    assert schemas == TOPICS
    counts = {topic: len(found) for topic, found in messages.items()}
    assert counts == {
        "/camera": FRAMES, "/pose": FRAMES, "/status": FRAMES,
        "/cells": -(-FRAMES // CELLS_EVERY), "/graph": 2, "/path": 1,
    }  # fmt: skip


def test_poses_pictures_and_graph_are_those_of_the_run(recorded):
    run, messages, _ = recorded
    track, brain = read_tum(run / "trajectory.tum"), load_brain(run / "brain.safetensors")
    times, poses = zip(*messages["/pose"], strict=True)
    assert np.array(times) / 1e9 == pytest.approx(track.times_s)
    path = messages["/path"][0][1]["poses"]
    for pose, true in zip(path, track.poses, strict=True):
        turn = pose["orientation"]
        found = (pose["position"]["x"], pose["position"]["y"], 2 * np.arctan2(turn["z"], turn["w"]))
        assert found[:2] == pytest.approx(true[:2])
        assert np.cos(found[2] - true[2]) == pytest.approx(1.0)
    assert poses[0]["frame_id"] == "map"
    (entity,) = messages["/graph"][-1][1]["entities"]
    assert len(entity["spheres"]) == brain.map.n
    assert len(entity["lines"][0]["points"]) == 2 * brain.map.n_links
    for topic, channels in (("/camera", 3), ("/cells", 1)):
        data = np.frombuffer(base64.b64decode(messages[topic][-1][1]["data"]), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        assert (1 if picture.ndim == 2 else picture.shape[2]) == channels
        assert picture.std() > 1.0
