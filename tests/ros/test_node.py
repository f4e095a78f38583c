"""A recorded conversation through the node gives the map of ``run``; transforms as in REP 105."""

import math

import numpy as np
import pytest

from neuroslam import NavigationBrain, open_source
from neuroslam.brain import load_brain
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.geometry import compose
from neuroslam.ros.node import (
    LOST_M2,
    MapEvent,
    MapGraph,
    MapPath,
    MappingNode,
    MapPose,
    MapTransform,
    variance_of,
)
from neuroslam.ros.settings import RosSettings
from neuroslam.ros.streams import MessageStreams
from neuroslam.runs.run import run
from neuroslam.sensors.bag_odometry import odometry_sample
from neuroslam.sensors.bag_topics import time_of
from neuroslam.types import Pose, Velocity

WORDS = "frame_rate_hz=10 view.threshold=0.06"
SETTINGS = {
    "set": WORDS, "image_topic": "/camera", "odometry_topic": "/odom", "scan_topic": "/scan",
}  # fmt: skip


def node_of(**more):
    return MappingNode(RosSettings.of(SETTINGS | more), log=lambda _: None)


def replay(node, conversation, until_s=math.inf):
    """Play a conversation into a node; return all that it publishes."""
    settings, out = node.settings, []
    for topic, received_ns, message in conversation:
        time_s = time_of(message, received_ns)
        if time_s > until_s:
            break
        if topic == settings.image_topic:
            out += node.on_image(message, time_s)
        elif topic == settings.odometry_topic:
            out += node.on_odometry(message, time_s)
        elif topic == settings.scan_topic:
            node.on_scan(message)
    return out


@pytest.fixture(scope="module")
def replayed(conversation):
    node = node_of()
    return node, replay(node, conversation)


def tensors(brain: NavigationBrain):
    """The state without the number and the source of its session, which differ."""
    state = brain.state_dict().items()
    return {
        name: value.numpy()
        for name, value in state
        if not name.endswith("session") and name != "sessions.text"
    }


def require_equal(brain, other):
    one, two = tensors(brain), tensors(other)
    assert one.keys() == two.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name], err_msg=name)


def test_the_map_is_that_of_run_on_the_bag(ros2_bag, replayed, tmp_path):
    source, (node, _) = f"{ros2_bag}?image=/camera", replayed
    n = len(list(open_source(source)))  # with --stop, as the map is not solved at the end then
    config = RosSettings.of(SETTINGS).brain_config()
    run(source, tmp_path / "run", config, stop=n, tensorboard=False)
    brain, live = load_brain(tmp_path / "run" / "brain.safetensors"), node.robot.brain
    assert brain.clock.frames_seen == live.clock.frames_seen == n
    assert brain.map.n > 30
    assert brain.map.n_links > brain.map.n  # a loop is closed
    require_equal(brain, live)
    assert node.refused == 0


def test_compressed_images_give_the_same_map(conversation, replayed):
    node = node_of(image_topic="/camera/compressed")
    replay(node, conversation)
    require_equal(node.robot.brain, replayed[0].robot.brain)


def test_the_instants_are_the_frames_of_the_bag_as_soon_as_they_are_sure(ros2_bag, conversation):
    node, seen = node_of(), []
    step = node._step

    def noting(instant):
        seen.append((instant, now_s))
        return step(instant)

    node._step = noting
    for message in conversation:
        now_s = message[1] * 1e-9
        replay(node, [message])
    frames = list(open_source(ros2_bag))
    assert [i.time_s for i, _ in seen] == [frame.time_s for frame in frames]
    assert [i.velocity for i, _ in seen] == [frame.velocity for frame in frames]
    assert [i.image is None for i, _ in seen] == [frame.image is None for frame in frames]
    for (instant, _), frame in zip(seen, frames, strict=True):
        assert (instant.ranges is None) == (frame.ranges is None)
        if frame.ranges is not None:
            np.testing.assert_array_equal(instant.ranges, frame.ranges)
    waits = np.array([now_s - instant.time_s for instant, now_s in seen])
    assert waits.max() < 0.1 + 0.04  # one period of the camera, and its delay


def test_the_transform_carries_odometry_onto_the_map(conversation, replayed):
    _, out = replayed
    times = {}
    for topic, received_ns, message in conversation:
        if topic == "/odom":
            p, q = message.pose.pose.position, message.pose.pose.orientation
            times[time_of(message, received_ns)] = Pose(p.x, p.y, 2.0 * math.atan2(q.z, q.w))
    poses = {one.time_s: one for one in out if isinstance(one, MapPose)}
    transforms = [one for one in out if isinstance(one, MapTransform)]
    assert len(transforms) == len(times.keys() & poses.keys()) > 100
    for one in transforms:
        assert (one.parent, one.child) == ("map", "odom")
        stamp_s = min(times, key=lambda t: abs(t + 0.1 - one.time_s))  # dated forward
        assert stamp_s + 0.1 == pytest.approx(one.time_s, abs=1e-6)
        on_map = compose(one.pose, times[stamp_s])
        assert on_map[:2] == pytest.approx(poses[stamp_s].pose[:2], abs=1e-9)
        assert math.cos(on_map.theta_rad - poses[stamp_s].pose.theta_rad) == pytest.approx(1.0)


def test_pose_graph_path_and_events_come_out(replayed):
    node, out = replayed
    brain = node.robot.brain
    poses = [one for one in out if isinstance(one, MapPose)]
    assert len(poses) == brain.clock.frames_seen
    graphs = [one for one in out if isinstance(one, MapGraph)]
    paths = [one for one in out if isinstance(one, MapPath)]
    span_s = poses[-1].time_s - poses[0].time_s
    assert len(graphs) == len(paths) == pytest.approx(span_s / 2.0, abs=1.5)
    last = node.graph(0.0)
    assert len(last.poses) == brain.map.n
    assert last.links.shape == (brain.map.n_links, 2)
    assert last.links.max() < brain.map.n
    path = node.path(0.0).poses
    assert len(path) >= brain.map.n  # every experience was visited
    assert np.hypot(*np.diff(path[:, :2], axis=0).T).max() < 4.0 * last.link_m
    closed = [one.text for one in out if isinstance(one, MapEvent)]
    assert any(text.startswith("loop_closed ") for text in closed)


def test_the_variance_grows_until_a_view_is_recognised():
    sure, later, lost = (variance_of(c, 0.1, 0.2) for c in (1.0, math.exp(-0.5), 0.0))
    assert sure == pytest.approx((0.01, 0.01, 0.04))
    assert later == pytest.approx((0.11, 0.11, 0.44))  # after 10 links
    assert lost[0] == LOST_M2


def test_the_next_day_the_stored_map_is_joined_and_a_goal_is_planned(conversation, tmp_path):
    path = str(tmp_path / "map.safetensors")
    first = node_of(map_file=path)
    assert first.goal(0.0, 0.0) == (False, "the map is empty", None)
    assert not first.load().done
    assert not first.save().done
    replay(first, conversation)
    n = first.robot.brain.map.n
    answer = first.goal(*first.robot.brain.map.poses[5, :2])
    assert answer.done
    assert "experience 5" in answer.text
    np.testing.assert_allclose(answer.path.poses[-1], first.robot.brain.map.poses[5])
    assert first.robot.brain.map.goals["experience"].tolist() == [5]
    assert first.goal(*first.robot.brain.map.poses[7, :2]).done
    assert first.robot.brain.map.goals["experience"].tolist() == [7]  # replaced
    assert first.close().done
    day = node_of(map_file=path)
    out = replay(day, conversation)
    assert any(o.text.startswith("joined") for o in out if isinstance(o, MapEvent))
    assert day.robot.brain.map.n < 1.3 * n  # of two laps on two days
    assert len(day.path(0.0).poses) > 20
    assert f"{n} experiences" in day.load().text
    assert day.robot.brain.map.n == 0


def test_localise_stores_the_map_until_the_robot_is_recognised(conversation):
    node = node_of()
    assert not node.localise().done
    replay(node, conversation, until_s=conversation[0][1] * 1e-9 + 4.0)
    n = node.robot.brain.map.n
    assert n > 10
    assert node.localise().done
    assert [one.map.n for one in node.robot.brain.stored] == [n]
    assert node.robot.brain.map.n == 0


def test_what_cannot_be_used_is_refused_with_a_reason_and_the_node_goes_on(conversation):
    said = []
    node = MappingNode(RosSettings.of(SETTINGS), said.append)
    assert node.waiting == "no image on /camera yet; no odometry on /odom yet"
    images = [m for topic, _, m in conversation if topic == "/camera"]
    odometry = [m for topic, _, m in conversation if topic == "/odom"]
    node.on_odometry(odometry[0], 10.0)
    assert node.waiting == "no image on /camera yet"
    assert node.on_odometry(odometry[1], 10.0) == []  # the same time again
    broken = type(images[0])(**(vars(images[0]) | {"encoding": "32FC1"}))
    assert node.on_image(broken, 10.0) == []
    assert node.refused == len(said) == 2
    assert "not after 10.000000 s" in said[0]
    assert "32FC1" in said[1]
    assert len(node.on_image(images[0], 10.0)) == 4  # pose, transform, graph, path
    assert node.waiting == ""


def test_a_sensor_that_stops_does_not_stop_the_other():
    streams = MessageStreams(lag_s=0.5)
    image = np.zeros((2, 2), np.uint8)
    streams.add_image(0.0, image)
    times = []
    for k in range(20):
        streams.add_odometry(0.1 * k, Velocity(1.0, 0.0))
        times += [instant.time_s for instant in streams.ready()]
    assert times == pytest.approx(np.arange(14) * 0.1)  # half a second behind
    with pytest.raises(BadFrame, match="came too late"):
        streams.add_image(0.25, image)
    streams.add_image(1.4, image)
    assert [(i.time_s, i.image is None) for i in streams.ready()] == [(pytest.approx(1.4), False)]


def test_one_sensor_alone_does_not_wait():
    streams = MessageStreams(odometry=False)
    streams.add_image(0.0, np.zeros((2, 2), np.uint8))
    assert [instant.velocity for instant in streams.ready()] == [None]


def test_motion_from_poses_is_that_of_the_twist(conversation):
    found = {}
    for motion in ("poses", "twist"):
        node = node_of(motion=motion)
        found[motion] = np.array(
            [
                node._velocity(odometry_sample(message, time_of(message, received_ns)))
                for topic, received_ns, message in conversation
                if topic == "/odom"
            ]
        )
    assert np.abs(found["twist"][:, 1]).max() > 0.1
    np.testing.assert_allclose(found["poses"][1:], found["twist"][1:], rtol=1e-5)


def test_a_wrong_parameter_is_one_line():
    with pytest.raises(ConfigError, match=r"^parameter motion: .*, got 'wheels'$"):
        RosSettings.of({"motion": "wheels"})
    with pytest.raises(ConfigError, match="unknown key 'threshold'"):
        node_of(set="view.treshold=0.05 threshold=1")
