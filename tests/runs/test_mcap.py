"""A run as an MCAP file: it is opened again by the reader of MCAP itself, and by rosbags."""

import cv2
import numpy as np
import pytest

from neuroslam.brain import load_brain
from neuroslam.cli import main
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.runs.foxglove import DEFINITIONS, to_cdr
from neuroslam.runs.mcap import CELLS_EVERY, TOPICS

FRAMES = 55
RECORD_HZ = 5.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    pytest.importorskip("mcap", reason="needs the extra mcap")
    folder = tmp_path_factory.mktemp("mcap")
    source = f"world:corridor?width=64&height=40&frames_per_lap={FRAMES - 1}&laps=1"
    words = [source, "-o", str(folder / "run"), "--preset", "ratslam", "--no-tensorboard"]
    words += ["--record", "cells", "--rate", str(RECORD_HZ)]
    assert main(["run", *words, "--mcap", str(folder / "run.mcap")]) == 0
    assert main(["export", str(folder / "run"), str(folder / "export.mcap")]) == 0
    return folder


def read(path):
    """Every message of a file by topic, with its time in ns; each is deserialised by rosbags."""
    highlevel = pytest.importorskip("rosbags.highlevel", reason="needs the extra rosbag")
    found = {topic: [] for topic in TOPICS}
    with highlevel.AnyReader([path]) as reader:
        assert {c.topic: c.msgtype.replace("/msg/", "/") for c in reader.connections} == TOPICS
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found[connection.topic].append((time_ns, message))
    return found


@pytest.fixture(scope="module")
def written(folder):
    return read(folder / "run.mcap")


@pytest.fixture(scope="module")
def exported(folder):
    return read(folder / "export.mcap")


def of_plane(pose):
    turn = pose.orientation
    return pose.position.x, pose.position.y, 2.0 * np.arctan2(turn.z, turn.w)


def decoded(message):
    return cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("name", ["run.mcap", "export.mcap"])
def test_the_reader_of_mcap_finds_schemas_and_as_many_messages_as_rosbags(name, folder):
    from mcap.reader import make_reader

    counts, schemas = dict.fromkeys(TOPICS, 0), {}
    with (folder / name).open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages():
            counts[channel.topic] += 1
            schemas[channel.topic] = schema.name.replace("/msg/", "/")
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert message.data[:4] == b"\0\1\0\0"
        statistics = reader.get_summary().statistics
    assert schemas == TOPICS
    assert statistics.message_count == sum(counts.values())
    assert counts == {topic: len(messages) for topic, messages in read(folder / name).items()}


def test_every_channel_of_a_run_has_all_its_messages(written):
    assert {topic: len(found) for topic, found in written.items()} == {
        "/camera": FRAMES, "/pose": FRAMES, "/status": FRAMES,
        "/cells": -(-FRAMES // CELLS_EVERY), "/graph": 2, "/path": 1,
    }  # fmt: skip


def test_every_channel_of_an_export_has_all_its_messages(folder, exported):
    from neuroslam.state.activity import ActivityLog

    samples = ActivityLog.open(folder / "run" / "activity.zarr").n_samples
    assert 2 < samples < FRAMES
    assert {topic: len(found) for topic, found in exported.items()} == {
        "/camera": FRAMES, "/pose": FRAMES, "/status": FRAMES,
        "/cells": samples, "/graph": 1, "/path": 1,
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["written", "exported"])
def test_poses_pictures_and_graph_are_those_of_the_run(kind, folder, request):
    messages = request.getfixturevalue(kind)
    run = folder / "run"
    track, brain = read_tum(run / "trajectory.tum"), load_brain(run / "brain.safetensors")
    times, poses = zip(*messages["/pose"], strict=True)
    assert np.array(times) / 1e9 == pytest.approx(track.times_s)
    last = poses[-1].timestamp
    assert last.sec + 1e-9 * last.nanosec == pytest.approx(track.times_s[-1])
    tracks = [messages["/path"][0][1].poses]
    if kind == "exported":  # poses of the finished map, not of their time
        tracks.append([message.pose for message in poses])
    for found in tracks:
        x, y, heading = np.array([of_plane(pose) for pose in found]).T
        assert np.column_stack([x, y]) == pytest.approx(track.poses[:, :2])
        assert np.cos(heading - track.poses[:, 2]) == pytest.approx(1.0)
    assert poses[0].frame_id == "map"
    (entity,) = messages["/graph"][-1][1].entities
    assert np.array([of_plane(s.pose)[:2] for s in entity.spheres]) == pytest.approx(
        brain.map.poses[:, :2]
    )
    ends = np.array([(p.x, p.y) for p in entity.lines[0].points]).reshape(-1, 2, 2)
    assert ends[:, 0] == pytest.approx(brain.map.poses[brain.map.links.source, :2])
    assert ends[:, 1] == pytest.approx(brain.map.poses[brain.map.links.target, :2])
    for topic, channels in (("/camera", 3), ("/cells", 1)):
        picture = decoded(messages[topic][-1][1])
        assert (1 if picture.ndim == 2 else picture.shape[2]) == channels
        assert picture.std() > 1.0


def test_a_run_and_its_export_show_the_same_frames(written, exported):
    for one, other in zip(written["/camera"], exported["/camera"], strict=True):
        assert one[0] == other[0]
        assert np.array_equal(one[1].data, other[1].data)
    for (_, one), (_, other) in zip(written["/status"], exported["/status"], strict=True):
        assert (one.frame, one.action, one.template) == (other.frame, other.action, other.template)
        assert one.match_error == other.match_error
    first = written["/cells"][0]
    assert np.array_equal(decoded(first[1]), decoded(exported["/cells"][0][1]))


def test_pictures_that_are_gone_are_left_out_and_said(folder, tmp_path, capsys):
    import shutil

    run = tmp_path / "run"
    shutil.copytree(folder / "run", run)
    shutil.rmtree(run / "activity.zarr")
    source = tmp_path / "motion.csv"
    source.write_text("time_s,v_m_s,w_rad_s\n0.0,0.1,0.0\n0.5,0.1,0.0\n")
    out = tmp_path / "out.mcap"
    assert main(["export", str(run), str(out), "--source", str(source)]) == 0
    assert f"Left out: no pictures: {source} has none" in " ".join(capsys.readouterr().out.split())
    counts = {topic: len(found) for topic, found in read(out).items()}
    assert counts == {
        "/camera": 0, "/pose": FRAMES, "/status": FRAMES, "/cells": 1, "/graph": 1, "/path": 1,
    }  # fmt: skip
    assert main(["export", str(run), str(out), "--source", str(tmp_path / "none.mp4")]) == 2
    assert "none.mp4" in capsys.readouterr().err
    assert main(["export", str(run / "brain.safetensors"), str(tmp_path / "map.mcap")]) == 2
    assert "is not the folder of a run" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("kind", sorted(DEFINITIONS))
def test_the_bytes_of_an_empty_message_are_those_of_rosbags(kind):
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra rosbag")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    for one in DEFINITIONS:
        text = "\n".join(DEFINITIONS[one].split("; "))
        store.register(typesys.get_types_from_msg(text, one.replace("/", "/msg/")))
    name = kind.replace("/", "/msg/")
    data = to_cdr(kind, {})
    assert bytes(store.serialize_cdr(store.deserialize_cdr(data, name), name)) == data


def test_an_unknown_field_is_refused():
    with pytest.raises(KeyError, match="Time has no field 'nsec'"):
        to_cdr("builtin_interfaces/Time", {"nsec": 1})
