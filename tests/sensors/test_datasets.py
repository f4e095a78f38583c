"""Folders of known datasets, bags and cameras give the images, times, motion and truth."""

import itertools
import math

import cv2
import numpy as np
import pytest

from neuroslam.cli import main
from neuroslam.errors import RunError, SourceError
from neuroslam.report import write_report
from neuroslam.sensors import camera, open_source
from neuroslam.sensors.full_turn import full_turn
from neuroslam.sensors.open import absolute_spec
from neuroslam.tuning import tune

N = 12
EPOCH_S = 1_305_031_102.25
GREYS = [np.full((24, 32), 10 * k, np.uint8) for k in range(N)]
TIMES = EPOCH_S + 0.1 * np.arange(N)
HEADINGS = np.linspace(0.0, 2.0, N)
XY = np.column_stack([np.arange(N) * 0.5, np.arange(N) * -0.25])


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def quaternions(rotation):
    """x, y, z, w of rotation matrices ``(3, 3)``, by way of OpenCV's rotation vector."""
    vector = cv2.Rodrigues(rotation)[0].ravel()
    angle = np.linalg.norm(vector)
    axis = vector / angle if angle > 0 else vector
    return [*(axis * math.sin(angle / 2)), math.cos(angle / 2)]


def camera_looking(heading):
    """Return a rotation whose third column looks along the heading, and its second one down."""
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return np.column_stack([np.cross(down, ahead), down, ahead])


def require(source, truth=True):
    frames = list(source)
    assert [int(frame.image.mean()) for frame in frames] == [10 * k for k in range(N)]
    np.testing.assert_allclose([frame.time_s for frame in frames], TIMES, atol=1e-6)
    if truth:
        np.testing.assert_allclose([frame.truth[:2] for frame in frames], XY, atol=2e-5)
        np.testing.assert_allclose([frame.truth[2] for frame in frames], HEADINGS, atol=2e-5)


def tum(folder):
    lines, poses = ["# time image"], ["# time tx ty tz qx qy qz qw"]
    for k in range(N):
        write(folder / "rgb" / f"{TIMES[k]:.6f}.png", GREYS[k])
        lines.append(f"{TIMES[k]:.6f} rgb/{TIMES[k]:.6f}.png")
    for time_s in np.arange(EPOCH_S - 0.05, TIMES[-1] + 0.1, 0.05):  # more often than images
        k = (time_s - EPOCH_S) / 0.1
        turned = quaternions(camera_looking(np.interp(k, np.arange(N), HEADINGS)))
        place = [np.interp(k, np.arange(N), XY[:, 0]), np.interp(k, np.arange(N), XY[:, 1]), 1.3]
        poses.append(" ".join(f"{value:.9f}" for value in [time_s, *place, *turned]))
    (folder / "rgb.txt").write_text("\n".join(lines))
    (folder / "groundtruth.txt").write_text("\n".join(poses))
    return folder


def kitti(folder):
    rows = []
    for k in range(N):
        write(folder / "image_0" / f"{k:06d}.png", GREYS[k])
        c, s = math.cos(HEADINGS[k]), math.sin(HEADINGS[k])  # x right, y down, z ahead
        matrix = np.array([[c, 0, -s, -XY[k, 1]], [0, 1, 0, 0], [s, 0, c, XY[k, 0]]])
        rows.append(" ".join(f"{value:.9e}" for value in matrix.ravel()))
    (folder / "times.txt").write_text("\n".join(f"{time_s:.6f}" for time_s in TIMES))
    (folder / "poses.txt").write_text("\n".join(rows))
    return folder


def euroc(folder):
    cam, truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir(parents=True)
    body_from_camera = camera_looking(0.0)  # the camera looks along the body's x
    images, poses = (
        ["#timestamp [ns],filename"],
        ["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z"],
    )
    for k in range(N):
        stamp = round(TIMES[k] * 1e9)
        write(cam / "data" / f"{stamp}.png", GREYS[k])
        images.append(f"{stamp},{stamp}.png")
        x, y, z, w = quaternions(camera_looking(HEADINGS[k]) @ body_from_camera.T)
        poses.append(f"{stamp},{XY[k, 0]},{XY[k, 1]},0.8,{w},{x},{y},{z},0,0,0")
    matrix = np.eye(4)
    matrix[:3, :3] = body_from_camera
    numbers = ", ".join(map(str, matrix.ravel()))
    (cam / "data.csv").write_text("\n".join(images))
    (cam / "sensor.yaml").write_text(
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\nrate: 20\n"
    )
    (truth / "data.csv").write_text("\n".join(poses))
    return folder


@pytest.mark.parametrize("make", [tum, kitti, euroc])
def test_a_dataset_gives_its_images_times_and_truth(make, tmp_path):
    require(open_source(make(tmp_path / "data")))


@pytest.mark.parametrize("make", [tum, kitti, euroc])
def test_a_dataset_is_mapped_and_its_times_are_kept(make, tmp_path):
    folder = make(tmp_path / "data")
    out = tmp_path / "out"
    small = ["--set", "view.template_width=16", "--set", "odometry.max_shift_px=8"]
    assert main(["run", str(folder), "-o", str(out), "--no-tensorboard", *small]) == 0
    times = np.loadtxt(out / "trajectory.tum")[:, 0]
    np.testing.assert_allclose(times, TIMES, atol=1e-6)


def test_truth_is_unknown_where_no_pose_is_near_in_time(tmp_path):
    folder = tum(tmp_path / "data")
    poses = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(poses[:8]))
    known = [frame.truth is not None for frame in open_source(folder)]
    assert known == sorted(known, reverse=True)
    assert 0 < sum(known) < N
    (folder / "groundtruth.txt").unlink()
    require(open_source(folder), truth=False)


def test_kitti_poses_lie_in_a_folder_of_their_own(tmp_path):
    folder = kitti(tmp_path / "sequences" / "07")
    (tmp_path / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "poses" / "07.txt")
    require(open_source(folder))


def test_real_kitti_poses_lie_on_the_ground(shared, tmp_path):
    poses = shared / "data" / "kitti_00" / "KITTI_00_gt.txt"
    if not poses.exists():
        pytest.skip("no kitti_00 beside the checkout")
    rows = [line for line in poses.read_text().splitlines() if len(line.split()) >= 12][:N]
    if len(rows) < N:
        pytest.skip("the poses are not in KITTI's own layout")
    folder = kitti(tmp_path / "data")
    (folder / "poses.txt").write_text("\n".join(rows))
    truth = np.array([frame.truth for frame in open_source(folder)])
    moved = np.diff(truth[:, :2], axis=0)
    ahead = np.column_stack([np.cos(truth[:-1, 2]), np.sin(truth[:-1, 2])])
    assert (moved * ahead).sum() > 0.99 * np.linalg.norm(moved, axis=1).sum()  # a car


@pytest.mark.parametrize(
    ("make", "damage", "message"),
    [
        (tum, lambda d: (d / "groundtruth.txt").write_text("1 2 3"), "expected 8 numbers"),
        (tum, lambda d: (d / "rgb.txt").write_text("# nothing"), "lists no images"),
        (kitti, lambda d: (d / "poses.txt").write_text("1 2 3"), "expected 12 numbers"),
        (kitti, lambda d: (d / "times.txt").write_text("0.0"), "1 times for 12 images"),
        (kitti, lambda d: [f.unlink() for f in (d / "image_0").iterdir()], "contains no images"),
        (euroc, lambda d: (d / "mav0/cam0/data.csv").write_text("a,b"), "time in ns"),
        (euroc, lambda d: (d / "mav0/cam0/sensor.yaml").write_text("T_BS: 3"), "no T_BS"),
    ],
)
def test_a_damaged_dataset_is_one_line(make, damage, message, tmp_path):
    folder = make(tmp_path / "data")
    damage(folder)
    with pytest.raises(SourceError, match=message) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)


# --- bags ---------------------------------------------------------------------------------------


@pytest.fixture(params=["ros1.bag", "ros2", "ros2_mcap"])
def bag(request, tmp_path):
    pytest.importorskip("rosbags", reason="needs the extra rosbag")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    path = tmp_path / request.param
    first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    kind = store.types

    def header(time_s):
        stamp = kind["builtin_interfaces/msg/Time"](int(time_s), round((time_s % 1) * 1e9))
        more = {"seq": 0} if first else {}
        return kind["std_msgs/msg/Header"](stamp=stamp, frame_id="", **more)

    def vector(x=0.0, y=0.0, z=0.0, of="Vector3"):
        return kind[f"geometry_msgs/msg/{of}"](x, y, z)

    def image(k):
        colour = np.repeat(GREYS[k][:, :, None], 3, 2)
        return kind["sensor_msgs/msg/Image"](
            header(TIMES[k]), 24, 32, "rgb8", 0, 96, colour.reshape(-1)
        )

    def compressed(k):
        data = cv2.imencode(".png", GREYS[k])[1].ravel()
        return kind["sensor_msgs/msg/CompressedImage"](header(TIMES[k]), "png", data)

    def odometry(time_s):
        still = np.zeros(36)
        pose = kind["geometry_msgs/msg/Pose"](
            vector(of="Point"), kind["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        )
        twist = kind["geometry_msgs/msg/Twist"](vector(2.0), vector(z=0.5))
        return kind["nav_msgs/msg/Odometry"](
            header(time_s), "base",
            kind["geometry_msgs/msg/PoseWithCovariance"](pose, still),
            kind["geometry_msgs/msg/TwistWithCovariance"](twist, still),
        )  # fmt: skip

    def scan(time_s):
        ranges = np.array([1.0, 2.0, 99.0], np.float32)
        return kind["sensor_msgs/msg/LaserScan"](
            header(time_s), -math.pi / 2, math.pi / 2, math.pi / 2, 0.0, 0.1, 0.05, 30.0,
            ranges, np.zeros(0, np.float32),
        )  # fmt: skip

    kept = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
    writer = Writer1(path) if first else Writer2(path, version=9, storage_plugin=kept)
    messages = [(TIMES[k], "/front", image(k)) for k in range(N)]
    messages += [(TIMES[k] + 1e-4, "/packed", compressed(k)) for k in range(N)]
    for time_s in np.arange(TIMES[0], TIMES[-1], 0.05):
        messages += [
            (time_s, "/wheels", odometry(time_s)),
            (time_s - 0.001, "/laser", scan(time_s)),
        ]
    with writer:
        connections = {}
        for time_s, topic, message in sorted(messages, key=lambda item: item[:2]):
            msgtype = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            write_as = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(connections[topic], round(time_s * 1e9), write_as(message, msgtype))
    return path


def test_a_bag_gives_images_motion_and_ranges_merged_by_time(bag):
    frames = list(open_source(bag))
    images = [frame for frame in frames if frame.image is not None]
    assert [int(frame.image.mean()) for frame in images] == [10 * k for k in range(len(images))]
    assert len(images) >= N - 1
    times = np.array([frame.time_s for frame in frames])
    driven = sum(f.velocity.v_m_s * dt for f, dt in zip(frames[1:], np.diff(times), strict=True))
    assert driven == pytest.approx(2.0 * (times[-1] - times[0]))
    assert {frame.velocity.w_rad_s for frame in frames[1:]} == {0.5}
    seen = frames[5].ranges
    assert (seen[270], seen[0]) == (1.0, 2.0)
    assert np.isinf(seen[90])  # 99 m is beyond its reach
    assert np.isinf(seen[180])


def test_a_topic_may_be_chosen_and_an_unknown_one_is_one_line(bag):
    packed = [f for f in open_source(f"{bag}?image=/packed") if f.image is not None]
    assert packed[0].time_s == pytest.approx(TIMES[0])
    with pytest.raises(
        SourceError, match="'/none' is not in the bag; topics for image: /front, /pac"
    ):
        open_source(f"{bag}?image=/none")
    with pytest.raises(SourceError, match="unknown option 'picture'"):
        open_source(f"{bag}?picture=/front")
    assert absolute_spec(f"{bag}?image=/packed") == f"{bag.resolve()}?image=/packed"


def test_a_bag_is_mapped(bag, tmp_path):
    assert main(["run", str(bag), "-o", str(tmp_path / "out"), "--no-tensorboard",
                 "--set", "view.template_width=16"]) == 0  # fmt: skip


def storage(bag):
    """Return the file that holds the messages."""
    return bag if bag.is_file() else next(file for file in bag.iterdir() if file.suffix != ".yaml")


def test_the_file_alone_gives_what_its_folder_gives(bag):
    assert storage(bag).suffix in (".bag", ".mcap" if "mcap" in bag.name else ".db3")
    alone, whole = (list(open_source(path)) for path in (storage(bag), bag))
    assert [frame.time_s for frame in alone] == [frame.time_s for frame in whole]


def test_a_broken_bag_is_one_line(bag):
    damaged = storage(bag)
    damaged.write_bytes(damaged.read_bytes()[:100])
    with pytest.raises(SourceError, match="is damaged or incomplete") as caught:
        open_source(bag)
    assert "\n" not in str(caught.value)


def test_rays_go_to_the_bearing_they_have():
    turn = full_turn(np.arange(1.0, 361.0), -math.pi, math.radians(1.0), 0.5, 1e3)
    assert turn[0] == 181.0  # straight ahead is the middle of the scan
    assert turn[90] == 271.0
    assert turn[180] in (1.0, 361.0)
    assert np.isfinite(turn).all()


# --- a camera -----------------------------------------------------------------------------------


class FakeDevice:
    """Stands in for OpenCV's capture: some images, then none."""

    opened = True

    def __init__(self, device):
        self.images = iter(GREYS[:5])
        self.device = device

    def isOpened(self):  # noqa: N802
        return self.opened

    def get(self, _):
        return 30.0

    def read(self):
        image = next(self.images, None)
        return image is not None, None if image is None else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)

    def release(self):
        pass


def test_a_camera_gives_images_at_the_times_they_come(monkeypatch):
    monkeypatch.setattr(camera.cv2, "VideoCapture", FakeDevice)
    source = open_source("camera:0")
    assert (source.name, source.n_frames, source.frame_rate_hz) == ("camera:0", None, 30.0)
    frames = list(itertools.islice(source.frames(), 5))
    assert [int(frame.image.mean()) for frame in frames] == [0, 10, 20, 30, 40]
    times = [frame.time_s for frame in frames]
    assert times == sorted(times)
    assert times[0] > 1.7e9
    assert [frame.index for frame in source.frames(7, 9)] == [7, 8]
    assert absolute_spec("camera:0") == "camera:0"


def test_a_live_camera_is_refused_where_frames_are_read_twice(monkeypatch, tmp_path):
    monkeypatch.setattr(camera.cv2, "VideoCapture", FakeDevice)
    small = ["--set", "view.template_width=16", "--set", "odometry.max_shift_px=8"]
    out = tmp_path / "out"
    assert main(["run", "camera:0", "-o", str(out), "--stop", "5", "--no-tensorboard", *small]) == 0
    page = write_report(out, source=True).read_text()
    assert "a live source cannot be read again" in page
    with pytest.raises(RunError, match="camera:0: is live; tuning reads its source several times"):
        tune("camera:0", tmp_path / "tuned")


def test_a_camera_that_stops_or_is_not_there_is_one_line(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(camera.cv2, "VideoCapture", FakeDevice)
    with pytest.raises(SourceError, match="delivers no more images after 5"):
        list(open_source("camera:0"))
    monkeypatch.setattr(FakeDevice, "opened", False)
    assert main(["run", "camera:3", "-o", str(tmp_path / "out")]) == 2
    assert "camera:3: cannot be opened" in capsys.readouterr().err
    with pytest.raises(SourceError, match="expected camera:0"):
        open_source("camera:")
