"""Of a bag those topics are read that hold a camera and motion, and the choice is told."""

import math

import cv2
import numpy as np
import pytest

from neuroslam.errors import BadFrame, SourceError
from neuroslam.sensors import open_source
from neuroslam.sensors.bag_odometry import OdometrySample, check_odometry
from neuroslam.sensors.full_turn import full_turn

pytest.importorskip("rosbags", reason="needs the extra rosbag")

H, W, N = 24, 32, 40
EPOCH_S = 1_600_000_000.0
GREYS = np.random.default_rng(0).integers(10, 250, (N, H, W)).astype(np.uint8)
DT_S = 0.1
SPEED, RATE = 0.8, 0.5  # a circle


class Bag:
    """Writes a small bag; every message has a header."""

    def __init__(self, path):
        from rosbags.typesys import Stores, get_typestore

        self.path, self.first = path, path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        self.types = self.store.types
        self.messages = []

    def header(self, time_s):
        stamp = self.types["builtin_interfaces/msg/Time"](int(time_s), round(time_s % 1 * 1e9))
        more = {"seq": 0} if self.first else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id="odom", **more)

    def add(self, topic, time_s, message, data=None):
        self.messages.append((time_s, topic, message, data))

    def image(self, topic, time_s, pixels, encoding):
        data = np.ascontiguousarray(pixels)
        step = data.nbytes // len(data)
        self.add(topic, time_s, self.types["sensor_msgs/msg/Image"](
            self.header(time_s), len(data), W, encoding, 0, step, data.reshape(-1).view(np.uint8)
        ))  # fmt: skip

    def packed(self, topic, time_s, pixels, kind):
        data = cv2.imencode(".png", pixels)[1].ravel()
        self.add(topic, time_s, self.types["sensor_msgs/msg/CompressedImage"](
            self.header(time_s), kind, data
        ))  # fmt: skip

    def odometry(self, topic, time_s, pose=(0.0, 0.0, 0.0), twist=(0.0, 0.0, 0.0), z=0.0):
        t, (x, y, heading), (vx, vy, w) = self.types, pose, twist
        turned = t["geometry_msgs/msg/Quaternion"](
            0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)
        )
        place = t["geometry_msgs/msg/Pose"](t["geometry_msgs/msg/Point"](x, y, z), turned)
        vector = t["geometry_msgs/msg/Vector3"]
        speed = t["geometry_msgs/msg/Twist"](vector(vx, vy, 0.0), vector(0.0, 0.0, w))
        self.add(topic, time_s, t["nav_msgs/msg/Odometry"](
            self.header(time_s), "base_link",
            t["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
            t["geometry_msgs/msg/TwistWithCovariance"](speed, np.zeros(36)),
        ))  # fmt: skip

    def scan(self, topic, time_s, ranges):
        self.add(topic, time_s, self.types["sensor_msgs/msg/LaserScan"](
            self.header(time_s), -1.0, 1.0, 0.5, 0.0, 0.1, 0.05, 30.0,
            np.array(ranges, np.float32), np.zeros(0, np.float32),
        ))  # fmt: skip

    def write(self):
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import Writer as Writer2

        serialize = self.store.serialize_ros1 if self.first else self.store.serialize_cdr
        with Writer1(self.path) if self.first else Writer2(self.path, version=9) as writer:
            connections = {}
            for time_s, topic, message, data in sorted(self.messages, key=lambda m: m[:2]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                written = serialize(message, kind) if data is None else data
                writer.write(connections[topic], round(time_s * 1e9), written)
        return self.path


@pytest.fixture(params=["ros1.bag", "ros2"])
def bag(request, tmp_path):
    return Bag(tmp_path / request.param)


def times(n=N):
    return EPOCH_S + DT_S * np.arange(n)


def circle(n=N):
    """Poses, headings and speeds of a robot on a circle."""
    t = DT_S * np.arange(n)
    radius = SPEED / RATE
    heading = RATE * t
    return np.column_stack([radius * np.sin(heading), radius * (1 - np.cos(heading)), heading])


def greys_of(source):
    return np.stack([frame.image for frame in source if frame.image is not None])


# --- choice of the camera ------------------------------------------------------------------------


def rivals(bag, others):
    """A camera /zz/image_raw, and other topics whose names come first."""
    for k, time_s in enumerate(times()):
        bag.image("/zz/image_raw", time_s, np.repeat(GREYS[k][..., None], 3, 2), "rgb8")
        others(bag, k, time_s + 1e-3)
    return open_source(bag.write())


OTHERS = {
    "16-bit depth": lambda b, k, t: b.image(
        "/aligned_depth/image_raw", t, np.full((H, W), 1500 + k, np.uint16), "16UC1"
    ),
    "mono16 depth": lambda b, k, t: b.image(
        "/a/depth", t, np.full((H, W), 1500 + k, np.uint16), "mono16"
    ),
    "32-bit depth": lambda b, k, t: b.image(
        "/a/points", t, np.full((H, W), 1.5, np.float32), "32FC1"
    ),
    "16UC1 of no name": lambda b, k, t: b.image(
        "/a/raw", t, GREYS[k].astype(np.uint16) * 9, "16UC1"
    ),
    "debug": lambda b, k, t: b.image("/a/debug_image", t, GREYS[-k - 1], "mono8"),
    "annotated": lambda b, k, t: b.packed("/a/detections/compressed", t, GREYS[-k - 1], "png"),
    "labels": lambda b, k, t: b.image("/a/segmentation", t, GREYS[-k - 1], "mono8"),
    "infrared": lambda b, k, t: b.image("/camera/infra1/image", t, GREYS[-k - 1], "mono8"),
    "black": lambda b, k, t: b.image("/a/camera", t, np.zeros((H, W), np.uint8), "mono8"),
    "few": lambda b, k, t: k or b.image("/a/calibration", t, GREYS[-1], "mono8"),
    "compressed depth": lambda b, k, t: b.packed(
        "/a/image/compressedDepth", t, GREYS[k], "16UC1; compressedDepth png"
    ),
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_camera_is_chosen_before_topics_that_are_none(other, bag):
    source = rivals(bag, OTHERS[other])
    np.testing.assert_array_equal(greys_of(source), GREYS)
    (note,) = source.notes
    assert "image topic: /zz/image_raw (rgb8, 32 x 24 px, 40 messages)" in note
    rival = next(m[1] for m in bag.messages if m[1] != "/zz/image_raw")
    assert f"not {rival} (" in note


def test_of_two_cameras_the_first_by_name_is_read_and_both_are_told(bag):
    source = rivals(bag, lambda b, k, t: b.image("/left/image", t, GREYS[-k - 1], "mono8"))
    np.testing.assert_array_equal(greys_of(source), GREYS[::-1])
    assert (
        "/left/image (mono8, 32 x 24 px, 40 messages); not /zz/image_raw (rgb8" in source.notes[0]
    )


def test_depth_alone_is_refused_by_name_and_read_where_it_is_asked_for(bag):
    for time_s in times():
        bag.image("/depth/image", time_s, GREYS[0].astype(np.uint16) * 16, "16UC1")
    path = bag.write()
    with pytest.raises(SourceError, match=r"no image topic: /depth/image \(16UC1, .*, depth\)"):
        open_source(path)
    np.testing.assert_array_equal(greys_of(open_source(f"{path}?image=/depth/image"))[3], GREYS[0])


def test_an_encoding_that_cannot_be_read_is_told_with_the_other_topics(bag):
    for k, time_s in enumerate(times()):
        bag.image("/depth/image", time_s, np.full((H, W), 1.5, np.float32), "32FC1")
        bag.image("/rgb/image", time_s, GREYS[k], "mono8")
    path = bag.write()
    message = r"'/depth/image' cannot be read: depth; other topics for image: /rgb/image \(mono8"
    with pytest.raises(SourceError, match=message):
        open_source(f"{path}?image=/depth/image")


def test_unknown_encodings_alone_are_a_line_with_the_encoding(bag):
    for time_s in times():
        bag.image("/camera", time_s, np.zeros((H, W), np.int16), "16SC1")
    with pytest.raises(SourceError, match="encoding '16SC1'; expected one of") as caught:
        open_source(bag.write())
    assert "\n" not in str(caught.value)


# --- pixels --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16", "packed"])
def test_pixels_are_scaled_by_the_bits_that_they_hold(bits, encoding, bag):
    for k, time_s in enumerate(times(6)):
        deep = GREYS[k].astype(np.uint16) << (bits - 8)
        if encoding == "packed":
            bag.packed("/camera", time_s, deep, "mono16; png compressed")
        else:
            pixels = np.repeat(deep[..., None], 3, 2) if encoding == "rgb16" else deep
            bag.image("/camera", time_s, pixels, encoding)
    source = open_source(bag.write())
    np.testing.assert_array_equal(greys_of(source), GREYS[:6])
    assert ("16-bit images use" in "".join(source.notes)) == (bits < 16)


# --- bad frames ----------------------------------------------------------------------------------


def test_a_bad_frame_is_one_of_its_topic_and_not_a_damaged_bag(bag):
    for k, time_s in enumerate(times(8)):
        if k == 3:  # half an image
            bag.image("/camera", time_s, GREYS[k], "mono8")
            bag.messages[-1][2].data = bag.messages[-1][2].data[: H * W // 2]
        elif k == 5:  # no message at all
            bag.image("/camera", time_s, GREYS[k], "mono8")
            bag.messages[-1] = (*bag.messages[-1][:3], b"\x00\x01\x00\x00\x07")
        else:
            bag.image("/camera", time_s, GREYS[k], "mono8")
    source = open_source(bag.write())
    with pytest.raises(BadFrame, match="/camera: frame 3: 384 bytes in rows of 32 for 32 x 24 px"):
        list(source)
    bad = []
    frames = list(source.frames(on_bad_frame=bad.append))
    assert [frame.index for frame in frames] == [0, 1, 2, 4, 6, 7]
    assert "frame 5: its message is damaged" in str(bad[1])
    assert not any("is damaged or incomplete" in str(error) for error in bad)


def test_a_time_twice_is_told_as_it_is_and_costs_one_frame(bag, tmp_path, call):
    stamps = times()
    stamps[20] = stamps[19]
    for k, time_s in enumerate(stamps):
        bag.odometry("/odom", time_s, (0.1 * k, 0, 0), (1.0, 0, 0))
    path = bag.write()
    stopped = call("run", path, "-o", tmp_path / "a", "--no-tensorboard")
    assert stopped.code == 2
    assert "times must rise; to leave out such frames: --on-bad-frame skip" in stopped.err
    assert "damaged" not in stopped.err
    skipped = call("run", path, "-o", tmp_path / "b", "--no-tensorboard", "--on-bad-frame", "skip")
    assert skipped.code == 0
    assert "39 frames" in skipped.out


def test_a_scan_without_beams_is_told_and_others_are_read(bag):
    for k, time_s in enumerate(times()):
        bag.odometry("/odom", time_s, (0.1 * k, 0, 0), (1.0, 0, 0))
        bag.scan("/scan", time_s - 0.01, [] if k == 20 else [1.0, 2.0, 3.0, 4.0, 5.0])
    bad = []
    frames = list(open_source(bag.write()).frames(on_bad_frame=bad.append))
    assert len(frames) == N
    assert ["/scan: scan of 0 beams" in str(error) for error in bad] == [True]
    with pytest.raises(BadFrame, match=r"in steps of 0\.0 rad"):
        full_turn(np.ones(3), 0.0, 0.0, 0.1, 9.0)


# --- odometry ------------------------------------------------------------------------------------


def twists(poses):
    n = len(poses)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    true = np.tile([SPEED, 0.0, RATE], (n, 1))
    return {
        "zero": 0.0 * true,
        "no speed": true * [0, 0, 1],
        "no turn": true * [1, 0, 0],
        "of the map": np.column_stack([SPEED * c, SPEED * s, np.full(n, RATE)]),
        "degrees": true * [1, 1, 57.29578],
        "millimetres": true * [1000, 1000, 1],
        "turned about": true * [1, 1, -1],
        "not a number": true * np.nan,
    }


REASONS = {
    "zero": "its twist is zero while its poses move 3.1 m and turn 1.9 rad",
    "no speed": "its linear twist is zero while",
    "no turn": "its turn rate is zero while its poses turn",
    "of the map": "its twist is in the frame of the map",
    "degrees": "its turn rate is 57.3 times that of its poses: degrees for radians",
    "millimetres": "its speed is 1e+03 times that of its poses",
    "turned about": "its turn rate is -1 times that of its poses",
    "not a number": "its twist is not a number",
}


@pytest.mark.parametrize("fault", REASONS)
def test_poses_give_the_motion_where_the_twist_does_not_agree_with_them(fault, bag):
    poses = circle()
    for time_s, pose, twist in zip(times(), poses, twists(poses)[fault], strict=True):
        bag.odometry("/odom", time_s, pose, twist)
    source = open_source(bag.write())
    frames = list(source)
    velocities = np.array([frame.velocity for frame in frames])
    np.testing.assert_allclose(velocities[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(velocities[1:, 0], SPEED, rtol=2e-3)  # the chord of an arc
    np.testing.assert_allclose(velocities[1:, 1], RATE, rtol=1e-5)
    assert f"motion from its poses: {REASONS[fault]}" in source.notes[0]


def test_a_sound_twist_is_used_and_nothing_is_said(bag):
    for time_s, pose in zip(times(), circle(), strict=True):
        bag.odometry("/odom", time_s, pose, (SPEED, 0.0, RATE))
    source = open_source(bag.write())
    assert {frame.velocity for frame in source} == {(SPEED, RATE)}
    assert source.notes[0].endswith("odometry topic: /odom (40 messages)")


def test_the_part_of_odometry_may_be_asked_for(bag):
    poses = circle()
    for time_s, pose, twist in zip(times(), poses, twists(poses)["degrees"], strict=True):
        bag.odometry("/odom", time_s, pose, twist)
    path = bag.write()
    asked = list(open_source(f"{path}?motion=twist"))
    assert asked[3].velocity.w_rad_s == pytest.approx(RATE * 57.29578)
    with pytest.raises(SourceError, match="motion is 'pose'; expected twist or poses"):
        open_source(f"{path}?motion=pose")


def test_poses_that_are_never_filled_leave_the_twist(bag):
    for time_s in times():
        bag.odometry("/odom", time_s, twist=(SPEED, 0.0, RATE))
    source = open_source(bag.write())
    assert {frame.velocity for frame in source} == {(SPEED, RATE)}
    assert "its poses do not move, its twist does" in source.notes[0]


def test_odometry_in_camera_axes_is_refused(bag):
    for k, time_s in enumerate(times()):
        bag.odometry("/vo", time_s, z=0.1 * k)
    with pytest.raises(SourceError, match=r"no odometry topic: /vo \(.* along z .*expected z up"):
        open_source(bag.write())


def test_odometry_that_moves_is_chosen_before_truth_and_what_stands_still(bag):
    for time_s, pose in zip(times(), circle(), strict=True):
        bag.odometry("/a_idle", time_s)
        bag.odometry("/ground_truth/odom", time_s, pose, (SPEED, 0.0, RATE))
        bag.odometry("/wheels", time_s, pose, (SPEED, 0.0, RATE))
    (note,) = open_source(bag.write()).notes
    assert "odometry topic: /wheels (40 messages); not /ground_truth/odom" in note
    assert "/a_idle (40 messages, does not move)" in note


def samples(poses, twists_, dt_s=0.01):
    rows = zip(dt_s * np.arange(len(poses)), poses, twists_, strict=True)
    return [OdometrySample(t, x, y, 0.0, h, vx, vy, 0.0, w) for t, (x, y, h), (vx, vy, w) in rows]


def test_noise_slip_and_a_correction_of_the_poses_are_no_disagreement():
    rng, n = np.random.default_rng(3), 3000
    t = 0.01 * np.arange(n)
    heading = np.cumsum(0.4 * np.sin(0.7 * t)) * 0.01
    speed = 0.5 + 0.3 * np.sin(0.3 * t)
    x, y = np.cumsum(speed * np.cos(heading)) * 0.01, np.cumsum(speed * np.sin(heading)) * 0.01
    poses = np.column_stack([x, y, heading]) + rng.normal(0, 2e-3, (n, 3))
    poses[1500:, :2] += 1.5  # a loop was closed
    measured = np.column_stack([1.05 * speed, 0 * t, 0.4 * np.sin(0.7 * t)])
    measured += rng.normal(0, 0.05, (n, 3))
    assert check_odometry([samples(poses, measured)]).use == "twist"


def test_a_robot_that_moves_sideways_is_told():
    n = 200
    poses = np.column_stack([0 * np.arange(n), 0.01 * np.arange(n), 0 * np.arange(n)])
    check = check_odometry([samples(poses, np.tile([0.0, 1.0, 0.0], (n, 1)))])
    assert check.use == "twist"
    assert "m sideways and 0.0 m ahead; only the forward speed is used" in check.why


def test_a_robot_that_stands_still_needs_no_word():
    still = np.zeros((100, 3))
    check = check_odometry([samples(still, still)])
    assert (check.use, check.why, check.moves) == ("twist", "", False)


# --- the cases -----------------------------------------------------------------------------------


@pytest.fixture
def case(shared):
    if not (shared / "cases").is_dir():
        pytest.skip("no cases beside the checkout")
    return lambda name: next((shared / "cases" / name).glob("*.bag"))


@pytest.mark.parametrize(
    ("name", "topic", "n"),
    [
        ("bag_32fc1_before_colour", "/camera/rgb/image_color", 4),
        ("bag_depth_before_colour", "/camera/color/image_raw", 8),
    ],
)
def test_the_cases_of_depth_are_read_as_colour(name, topic, n, case, tmp_path, call):
    done = call("run", case(name), "-o", tmp_path / "m", "--no-tensorboard")
    assert done.code == 0
    assert f"image topic: {topic} (rgb8" in done.out
    assert f"{n} frames" in done.out
    assert f"{n} templates" in done.out


def test_the_case_of_odometry_without_twist_moves_along_its_poses(case, tmp_path, call):
    source = open_source(case("bag_odometry_without_twist"))
    velocities = np.array([frame.velocity for frame in source])[1:]
    np.testing.assert_allclose(velocities, 0.5, rtol=1e-3)
    done = call("run", case("bag_odometry_without_twist"), "-o", tmp_path / "m", "--no-tensorboard")
    assert "motion from its poses" in done.out
    x, y = np.loadtxt(tmp_path / "m" / "trajectory.tum")[-1, 1:3]
    assert math.hypot(x, y) == pytest.approx(2 * math.sin(0.5 * 2.95), abs=0.01)


def test_the_case_of_doubled_odometry_says_what_is_doubled(case, tmp_path, call):
    path = case("bag_duplicated_odometry")
    stopped = call("run", path, "-o", tmp_path / "m", "--no-tensorboard")
    assert stopped.code == 2
    assert stopped.err.startswith(
        f"neuroslam run: stopped early: {path}: /odom: frame 21: its time"
    )
    assert stopped.err.endswith("times must rise; to leave out such frames: --on-bad-frame skip\n")
