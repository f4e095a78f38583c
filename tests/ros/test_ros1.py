"""The shell under a real ROS 1: a master on the loopback, a bag played, what comes out received."""

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from neuroslam.brain import load_brain

ROOT = Path(__file__).resolve().parents[2]
DEBIAN = "/usr/lib/python3/dist-packages"
PLAY = Path("/usr/lib/rosbag/play")

BOOT = """
import sys
sys.path.append({debian!r})  # last: packages of the environment come first
"""
NODE = BOOT + "from neuroslam.ros.ros1 import main\nraise SystemExit(main())\n"

CLIENT = (
    BOOT
    + """
import json, time
import rospy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

rospy.init_node("client")
got = {{"pose": [], "tf": [], "graph": [], "path": [], "event": []}}

def place(pose):
    return [pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w]

def on_pose(m):
    got["pose"].append([m.header.stamp.to_nsec(), place(m.pose.pose), list(m.pose.covariance)])

def on_tf(m):
    for t in m.transforms:
        v, q = t.transform.translation, t.transform.rotation
        got["tf"].append([t.header.frame_id, t.child_frame_id, t.header.stamp.to_nsec(),
                          [v.x, v.y, q.z, q.w]])

def on_graph(m):
    got["graph"].append([[k.ns, len(k.points)] for k in m.markers])

def on_path(m):
    got["path"].append([place(p.pose) for p in m.poses])

subscribers = [
    rospy.Subscriber("/neuroslam/pose", PoseWithCovarianceStamped, on_pose, queue_size=1000),
    rospy.Subscriber("/tf", TFMessage, on_tf, queue_size=1000),
    rospy.Subscriber("/neuroslam/graph", MarkerArray, on_graph, queue_size=100),
    rospy.Subscriber("/neuroslam/path", Path, on_path, queue_size=100),
    rospy.Subscriber("/neuroslam/event", String, lambda m: got["event"].append(m.data)),
]
for name in ("save", "load", "localise", "goal"):
    rospy.wait_for_service("/neuroslam/" + name, timeout=600)
while any(s.get_num_connections() == 0 for s in subscribers):
    rospy.sleep(0.05)
print("ready", flush=True)
sys.stdin.readline()  # the bag has been played
seen, until = -1, time.time() + 60.0
while len(got["pose"]) > seen and time.time() < until:  # until nothing more comes
    seen = len(got["pose"])
    rospy.sleep(2.0)
def call(name):
    answer = rospy.ServiceProxy("/neuroslam/" + name, Trigger)()
    return [answer.success, answer.message]
goal = rospy.ServiceProxy("/neuroslam/goal", GetPlan)
from nav_msgs.srv import GetPlanRequest
request = GetPlanRequest()
request.goal.pose.position.x, request.goal.pose.position.y = got["pose"][-40][1][:2]
got["plan"] = [place(p.pose) for p in goal(request).plan.poses]
got["save"], got["localise"] = call("save"), call("localise")
print(json.dumps(got), flush=True)
"""
)


def has_ros():
    code = BOOT.format(debian=DEBIAN) + "import rospy, tf2_msgs.msg, visualization_msgs.msg"
    try:
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


@pytest.fixture(scope="module")
def ros():
    """The environment of a master on a free port of the loopback."""
    if not (Path("/usr/bin/rosmaster").exists() and PLAY.exists() and has_ros()):
        pytest.skip("ROS 1 is not installed: needs rospy, rosmaster and rosbag, as Debian has them")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    env = os.environ | {
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1",
        "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1",
        "ROS_PACKAGE_PATH": f"{ROOT / 'examples'}:/usr/share",
    }  # fmt: skip
    master = subprocess.Popen(
        ["/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", str(port)],
        env={k: v for k, v in env.items() if k != "PYTHONPATH"},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    for _ in range(600):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.1)
    yield env
    end(master)


def end(process):
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def python(code, *words, env, **more):
    command = [sys.executable, "-c", code.format(debian=DEBIAN), *words]
    return subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True, **more)


def test_a_played_bag_is_mapped_and_everything_is_received(ros, ros1_bag, conversation, tmp_path):
    stored = tmp_path / "map.safetensors"
    words = {
        "image_topic": "/camera", "odometry_topic": "/odom", "scan_topic": "/scan",
        "set": "frame_rate_hz=10 view.threshold=0.06", "map_file": stored, "lag_s": 10.0,
    }  # fmt: skip
    words = [f"_{name}:={value}" for name, value in words.items()]
    with (
        python(NODE, *words, env=ros) as node,
        python(CLIENT, env=ros, stdin=subprocess.PIPE) as client,
        contextlib.ExitStack() as ended,
    ):
        ended.callback(end, node)
        ended.callback(end, client)
        assert client.stdout.readline() == "ready\n"
        played = subprocess.run(
            [str(PLAY), "-q", "-d", "5", "-r", "0.5", str(ros1_bag)],
            env=ros,
            capture_output=True,
            timeout=300,
        )
        assert played.returncode == 0, played.stderr
        client.stdin.write("\n")
        client.stdin.flush()
        got = json.loads(client.stdout.readline())
    stamps = [stamp for stamp, *_ in got["pose"]]
    sent = {topic: sum(t == topic for t, *_ in conversation) for topic in ("/camera", "/odom")}
    assert len(stamps) > 0.8 * sum(sent.values())  # a busy machine may lose some
    assert np.all(np.diff(stamps) > 0)
    assert np.abs(np.array(got["pose"][-1][1])).max() > 0.0
    assert len(got["pose"][0][2]) == 36
    assert {(parent, child) for parent, child, *_ in got["tf"]} == {("map", "odom")}
    assert len(got["tf"]) > 0.8 * sent["/odom"]
    assert got["save"][0]
    brain = load_brain(stored)  # by the service; after localise there was nothing to save
    counts = dict(got["graph"][-1])
    assert 20 < counts["experiences"] <= brain.map.n
    assert len(got["path"][-1]) >= counts["experiences"]
    assert any(text.startswith("loop_closed") for text in got["event"])
    assert got["save"][1].startswith(f"{brain.map.n} experiences")
    assert len(got["plan"]) > 1
    assert got["localise"][0]
    # The last transform carries the last odometry of the bag to the last pose.
    by_stamp = {stamp: place for stamp, place, _ in got["pose"]}
    odometry = {}
    for topic, _, message in conversation:
        if topic == "/odom":
            p, q = message.pose.pose.position, message.pose.pose.orientation
            stamp = message.header.stamp
            odometry[stamp.sec * 10**9 + stamp.nanosec] = (p.x, p.y, 2 * math.atan2(q.z, q.w))
    _, _, dated, (x, y, z, w) = got["tf"][-1]
    stamp = min(odometry, key=lambda s: abs(s + 10**8 - dated))
    ox, oy, _ = odometry[stamp]
    turn = 2 * math.atan2(z, w)
    on_map = (x + ox * math.cos(turn) - oy * math.sin(turn),
              y + ox * math.sin(turn) + oy * math.cos(turn))  # fmt: skip
    nearest = min(by_stamp, key=lambda s: abs(s - stamp))
    assert on_map == pytest.approx(by_stamp[nearest][:2], abs=1e-6)


def test_the_launch_file_starts_the_node_with_its_parameters(ros, tmp_path):
    if not Path("/usr/bin/roslaunch").exists():
        pytest.skip("roslaunch is not installed")
    done = subprocess.run(
        ["/usr/bin/python3", "/usr/bin/roslaunch", "--dump-params", "neuroslam_ros",
         "neuroslam.launch", "image:=/front", "map_file:=/tmp/map"],
        env={k: v for k, v in ros.items() if k != "PYTHONPATH"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "/neuroslam/image_topic: /front" in done.stdout
    assert "/neuroslam/map_file: /tmp/map" in done.stdout
