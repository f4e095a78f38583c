"""Every command in README and docs runs as it is printed, one after the other as a user would."""

import re
import shlex
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neuroslam import cli, record
from neuroslam.experiments import EXPERIMENTS
from neuroslam.sensors import open_source
from neuroslam.view import vision

ROOT = Path(__file__).resolve().parents[1]
OWN_TEST = ("own_population.md",)  # tests/docs runs it in an empty folder
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").glob("*.md")) if page.name not in OWN_TEST),
]
WORLD = "world:corridor?frames_per_lap=110&laps=1.4&width=160&height=120&grey=true"
SESSIONS = ("drive", "monday", "tuesday", "wednesday", "friday")
SHORT = {"world:": "40", "arena:": "200"}
"""Rendered worlds and arenas run for so many frames only, for the sake of time."""
MERGED = "1200"
"""Frames of an arena whose map is merged: until enough of its walls are known."""


def commands(page: Path) -> list[str]:
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(), re.DOTALL)
    lines = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("neuroslam ")]


def write_video(path, frames):
    code = "mp4v" if path.suffix == ".mp4" else "MJPG"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 20.0, (160, 120))
    for frame in frames:
        video.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    video.release()


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with all that the pages name: a user's own files."""
    home = tmp_path_factory.mktemp("home")
    frames = list(open_source(WORLD).frames())
    for name in SESSIONS:
        write_video(home / f"{name}.mp4", frames)
    write_video(home / "drive.avi", frames)
    pictures = home / "pictures"
    pictures.mkdir()
    for frame in frames:
        cv2.imwrite(str(pictures / f"{frame.index:06d}.png"), frame.image)
    with tarfile.open(home / "frames.tar", "w") as tar:
        tar.add(pictures, arcname="frames")
    rows = [f"{f.time_s},{f.velocity.v_m_s},{f.velocity.w_rad_s}" for f in frames if f.velocity]
    for name in ("odometry.csv", "log.csv"):
        (home / name).write_text("\n".join(["time_s,v_m_s,w_rad_s", *rows]) + "\n")
    poses = [f"{k / 20.0} {f.truth.x_m} {f.truth.y_m} 0 0 0 {np.sin(f.truth.theta_rad / 2)} "
             f"{np.cos(f.truth.theta_rad / 2)}" for k, f in enumerate(frames)]  # fmt: skip
    other_clock = [f"{1_700_000_000.05 + k / 20.0:.6f},{f.velocity.v_m_s},{f.velocity.w_rad_s}"
                   for k, f in enumerate(frames)]  # fmt: skip
    (home / "motion.csv").write_text("\n".join(["time_s,v_m_s,w_rad_s", *other_clock]) + "\n")
    camera_axes = [f"{k / 20.0} {-f.truth.y_m} 0 {f.truth.x_m} 0 {-np.sin(f.truth.theta_rad / 2)} "
                   f"0 {np.cos(f.truth.theta_rad / 2)}" for k, f in enumerate(frames)]  # fmt: skip
    (home / "orb_slam.tum").write_text("\n".join(camera_axes) + "\n")
    (home / "landmarks.csv").write_text("kind,number,name,words,corners\n,0,DOOR,BLUE * DOOR,\n")
    (home / "truth.tum").write_text("\n".join(poses) + "\n")
    angle = np.linspace(0.0, 5.0, 400)
    walk = 0.5 * np.column_stack([np.cos(angle), np.sin(0.7 * angle)])
    np.savez(home / "rat.npz", t=0.05 * np.arange(len(angle)), pos=walk, arena_radius=1.0)
    facing = np.degrees(np.arctan2(*np.gradient(walk, axis=0).T[::-1]))
    track = [
        f"{50 * k},{100 * x},{100 * y},{hd}"
        for k, ((x, y), hd) in enumerate(zip(walk, facing, strict=True))
    ]
    (home / "rat.csv").write_text("\n".join(["time,px,py,head", *track]))
    _datasets(home, frames)
    _landmarks(home)
    vision.load()
    from torchvision.models import mobilenet_v2

    with torch.random.fork_rng():
        torch.save(mobilenet_v2().state_dict(), home / "mobilenet_v2.pth")
    return home


def _landmarks(home):
    """A log of motion and sightings, and a folder of two robots, of which the second drives."""
    seen = [f"{1_700_000_000.05 + k / 20.0:.6f},7,2.0,30" for k in range(0, 100, 5)]
    (home / "sightings.csv").write_text("\n".join(["time_s,number,distance_m,bearing_deg", *seen]))
    files = {
        "Barcodes.dat": "1 5\n2 14\n6 72\n",
        "Landmark_Groundtruth.dat": "6 2.0 1.0 0 0\n",
        "Robot2_Odometry.dat": "".join(f"{100 + k / 50:.3f} 0.5 0.0\n" for k in range(200)),
        "Robot2_Measurement.dat": "100.55 72 2.0 0.52\n",
        "Robot2_Groundtruth.dat": "".join(
            f"{100 + k / 50:.3f} {k / 100} 0 0\n" for k in range(200)
        ),
    }
    folder = home / "MRCLAM_Dataset1"
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)


def _datasets(home, frames):
    tum, kitti, euroc = home / "tum_folder", home / "kitti/sequences/07", home / "euroc_folder"
    for folder in (tum / "rgb", kitti / "image_0", euroc / "mav0/cam0/data"):
        folder.mkdir(parents=True)
    (home / "kitti/poses").mkdir()
    lists = {"tum": [], "times": [], "poses": [], "euroc": []}
    for k, frame in enumerate(frames):
        time_s, c, s = k / 20.0 + 100.0, np.cos(frame.truth[2]), np.sin(frame.truth[2])
        for name in (tum / "rgb", kitti / "image_0"):
            cv2.imwrite(str(name / f"{k:06d}.png"), frame.image)
        cv2.imwrite(str(euroc / f"mav0/cam0/data/{k}.png"), frame.image)
        lists["tum"].append(f"{time_s} rgb/{k:06d}.png")
        lists["times"].append(f"{time_s}")
        lists["poses"].append(f"{c} 0 {-s} {-frame.truth[1]} 0 1 0 0 {s} 0 {c} {frame.truth[0]}")
        lists["euroc"].append(f"{round(time_s * 1e9)},{k}.png")
    (tum / "rgb.txt").write_text("\n".join(lists["tum"]))
    (kitti / "times.txt").write_text("\n".join(lists["times"]))
    (home / "kitti/poses/07.txt").write_text("\n".join(lists["poses"]))
    (euroc / "mav0/cam0/data.csv").write_text("\n".join(lists["euroc"]))


def write_bag(path, frames):
    """Write a ROS 1 bag with a camera and wheels."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = store.types
    vector, still = kind["geometry_msgs/msg/Vector3"], np.zeros(36)
    with Writer(path) as writer:
        names = {"/front": "sensor_msgs/msg/Image", "/wheels": "nav_msgs/msg/Odometry"}
        connections = {
            topic: writer.add_connection(topic, name, typestore=store)
            for topic, name in names.items()
        }
        for k, frame in enumerate(frames):
            seconds, nanoseconds = divmod(round((100.0 + k / 20.0) * 1e9), 10**9)
            stamp = kind["builtin_interfaces/msg/Time"](seconds, nanoseconds)
            header = kind["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="")
            h, w = frame.image.shape
            image = kind[names["/front"]](header, h, w, "mono8", 0, w, frame.image.ravel())
            pose = kind["geometry_msgs/msg/Pose"](
                kind["geometry_msgs/msg/Point"](0.0, 0.0, 0.0),
                kind["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            )
            v, turn = frame.velocity
            twist = kind["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(0.0, 0.0, turn))
            odometry = kind[names["/wheels"]](
                header, "base",
                kind["geometry_msgs/msg/PoseWithCovariance"](pose, still),
                kind["geometry_msgs/msg/TwistWithCovariance"](twist, still),
            )  # fmt: skip
            for topic, message in (("/front", image), ("/wheels", odometry)):
                data = store.serialize_ros1(message, names[topic])
                writer.write(connections[topic], seconds * 10**9 + nanoseconds, data)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda p: p.name)
def test_every_command_of_a_page_runs_as_printed(page, inputs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for source in inputs.iterdir():
        (tmp_path / source.name).symlink_to(source)
    if "drive.bag" in page.read_text():
        pytest.importorskip("rosbags", reason="needs the extra rosbag")
        write_bag(tmp_path / "drive.bag", list(open_source(WORLD).frames(0, 60)))
    if "session.nwb" in page.read_text():
        pytest.importorskip("pynwb", reason="needs the extra neuro")
        log = record("arena:square?minutes=0.3", only=["grid"])
        log.to_nwb(tmp_path / "session.nwb")
    merged = {map_ for line in commands(page) for map_ in line.split()[2:4] if " merge " in line}
    for line in commands(page):
        words = shlex.split(line, comments=True)[1:]
        if words[0] == "experiment":  # minutes or hours; each has small tests of its own
            assert words[1] in EXPERIMENTS
            continue
        if frames := SHORT.get(words[1][:6]):
            is_merged = words[1].startswith("arena:") and words[words.index("-o") + 1] in merged
            words += ["--stop", MERGED if is_merged else frames]
        code = cli.main(words)
        told = capsys.readouterr()
        assert code == 0, f"{line}\n{told.err}{told.out}"


@pytest.mark.parametrize("name", ["sweeps.md", "tuning.md", "features.md"])
def test_the_programs_of_a_page_run_as_printed(name, inputs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive.avi").symlink_to(inputs / "drive.avi")
    page = (ROOT / "docs" / name).read_text()
    for program in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(program, name, "exec"), {})
