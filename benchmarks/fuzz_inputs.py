"""Small sound inputs of every reader, and the ways in which :mod:`benchmarks.fuzz` damages them."""

import gzip
import io
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam import ActivityLog, record
from neuroslam.cli import main
from neuroslam.config import BrainConfig, to_toml
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.runs.truth import read_truth
from neuroslam.sensors import open_source
from neuroslam.sensors.landmarks import read_landmarks

N = 12  # frames of each input
TOKENS = (
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e308",
        b"-1",
        b"0",
        b"",
        b"9" * 400,
        b"9" * 5000,
        b"0x" + b"f" * 99,
    ),
    *(
        b"\0",
        b"\r",
        b"\r\n\r",
        b'"',
        b"," * 50,
        b"\xff\xfe",
        b"\x1b]0;x\x07",
        b"=1+1",
        b"\n\n",
        b"#",
    ),
    *(
        b"[" * 3000,
        b"{" * 3000,
        b'{"a":' * 3000,
        b"a." * 3000 + b"a=1",
        b"x" * 200_000,
        b"\xc3\x28",
    ),
    *(
        b"true",
        b"null",
        b"'",
        b"../../../etc/passwd",
        b"/dev/zero",
        b"2147483648",
        b"-9223372036854775809",
    ),
)
"""Texts that go into texts."""
WORDS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x10000)
"""Numbers that go into bytes, of one, two, four or eight."""


class Target(NamedTuple):
    """A reader and a sound input of it.

    Attributes:
        name: Kind of the input.
        files: Content of its files by name.
        damaged: Those that are damaged.
        read: Reads the input in a folder.
        is_text: Damage lines and words too.
    """

    name: str
    files: dict[str, bytes]
    damaged: tuple[str, ...]
    read: Callable[[Path], object]
    is_text: bool = False


def frames_of(name: str) -> Callable[[Path], None]:
    """Return a reader of the source of that name."""

    def read(folder: Path) -> None:
        for _ in open_source(str(folder / name)).frames(0, 3 * N, lambda _fault: None):
            pass

    return read


def command(*words: str) -> Callable[[Path], int]:
    """Return a command line in which ``@`` stands for the folder; it raises nothing."""

    def run(folder: Path) -> int:
        return main([word.replace("@", str(folder)) for word in words])

    return run


def picture(k: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """Return a coloured picture with contrast."""
    coarse = np.random.default_rng(k // 3).integers(0, 255, (6, 8, 3), np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST)


def targets(folder: Path) -> list[Target]:
    """Make the inputs; ``folder`` is for files that only libraries write."""
    jpegs = {f"{k:03d}.jpg": encoded(".jpg", k) for k in range(N)}
    motion = rows(
        "time_s,v_m_s,w_rad_s,x_m,y_m,theta_rad",
        [(0.1 * k, 0.5, 0.1, 0.05 * k, 0, 0.01 * k) for k in range(N)],
    )
    tum = rows("", [(0.1 * k, 0.05 * k, 0, 0, 0, 0, 0, 1) for k in range(N)], " ")
    times = b"\n".join(b"%.1f" % (0.1 * k) for k in range(N)) + b"\n"
    listed = rows("", [(f"{0.1 * k:.1f}", name) for k, name in enumerate(jpegs)], " ")
    config = to_toml(BrainConfig(cells="pose+place+semantic+head_direction+speed")).encode()
    euroc = rows("#t,f", [(10**8 * k, name) for k, name in enumerate(jpegs)])
    truth = rows("#t,x,y,z,w,x,y,z", [(10**8 * k, 0.1 * k, 0, 0, 1, 0, 0, 0) for k in range(N)])
    kitti = rows("", [(1, 0, 0, 0.1 * k, 0, 1, 0, 0, 0, 0, 1, 0.2 * k) for k in range(N)], " ")
    ini = b"[visual_odometry]\ncamera_fov_deg = 53\nvtrans_image_x_min = 10\ncamera_hz=10\n"
    ini += b"[ratslam]\npc_dim_xy=11\nvt_shift_match = 4\n"
    words = b"kind,number,name,words,corners\n"
    words += b"landmark,1,DOOR,BLUE * TALL,\nlandmark,2,CHAIR,RED,\nwall,,SIDE,GREY,1 2\n"
    words_toml = b'[[landmark]]\nname = "DOOR"\nnumber = 1\nwords = "BLUE * (TALL + WIDE)"\n'
    words_toml += b'[[wall]]\nname = "SIDE"\ncorners = [1, 1]\n'
    return [
        Target("motion CSV", {"m.csv": motion}, ("m.csv",), frames_of("m.csv"), True),
        Target("image list", {"l.txt": listed, **jpegs}, ("l.txt",), frames_of("l.txt"), True),
        Target(
            "folder: times, motion",
            {"times.txt": times, "odometry.csv": motion, **jpegs},
            ("times.txt", "odometry.csv"),
            frames_of(""),
            True,
        ),
        Target(
            "TUM folder",
            {"rgb.txt": listed, "groundtruth.txt": tum, **jpegs},
            ("rgb.txt", "groundtruth.txt"),
            frames_of(""),
            True,
        ),
        Target(
            "KITTI folder",
            {
                "times.txt": times,
                "poses.txt": kitti,
                **{f"image_0/{n}": d for n, d in jpegs.items()},
            },
            ("times.txt", "poses.txt"),
            frames_of(""),
            True,
        ),
        Target(
            "EuRoC folder",
            {
                "mav0/cam0/data.csv": euroc,
                "mav0/state_groundtruth_estimate0/data.csv": truth,
                **{f"mav0/cam0/data/{n}": d for n, d in jpegs.items()},
            },
            ("mav0/cam0/data.csv", "mav0/state_groundtruth_estimate0/data.csv"),
            frames_of(""),
            True,
        ),
        Target(
            "donkeycar tub", tub(jpegs), ("manifest.json", "catalog_0.catalog"), frames_of(""), True
        ),
        Target(
            "truth TUM",
            {"t.tum": tum},
            ("t.tum",),
            lambda f: (read_tum(f / "t.tum"), read_truth(f / "t.tum")),
            True,
        ),
        Target("truth CSV", {"t.csv": motion}, ("t.csv",), lambda f: read_truth(f / "t.csv"), True),
        Target(
            "landmarks CSV",
            {"w.csv": words},
            ("w.csv",),
            lambda f: read_landmarks(f / "w.csv"),
            True,
        ),
        Target(
            "landmarks TOML",
            {"w.toml": words_toml},
            ("w.toml",),
            lambda f: read_landmarks(f / "w.toml"),
            True,
        ),
        Target(
            "config TOML",
            {"c.toml": config},
            ("c.toml",),
            command("run", "@/none.avi", "-o", "@/out", "--config", "@/c.toml"),
            True,
        ),
        Target(
            "config ini",
            {"c.ini": ini},
            ("c.ini",),
            command("run", "@/none.avi", "-o", "@/out", "--config", "@/c.ini"),
            True,
        ),
        Target("npy", {"a.npy": saved(np.save)}, ("a.npy",), frames_of("a.npy")),
        Target(
            "npz",
            {"a.npz": saved(lambda f, p: np.savez(f, pos=p, t=0.1 * np.arange(N)))},
            ("a.npz",),
            frames_of("a.npz"),
        ),
        Target(
            "npz compressed",
            {"a.npz": saved(lambda f, p: np.savez_compressed(f, pos=p, t=0.1 * np.arange(N)))},
            ("a.npz",),
            frames_of("a.npz"),
        ),
        Target("tar", {"a.tar": tarred(jpegs)}, ("a.tar",), frames_of("a.tar")),
        Target(
            "tar.gz",
            {"a.tar.gz": gzip.compress(tarred(jpegs))},
            ("a.tar.gz",),
            frames_of("a.tar.gz"),
        ),
        *(
            Target(
                f"image {suffix[1:]}",
                {f"{k}{suffix}": encoded(suffix, k) for k in range(3)},
                (f"0{suffix}", f"1{suffix}"),
                frames_of(""),
            )
            for suffix in (".jpg", ".png", ".bmp", ".tif", ".webp", ".pgm")
        ),
        *(
            Target(f"video {name[2:]}", {name: video(folder / name)}, (name,), frames_of(name))
            for name in ("v.avi", "v.mp4", "v.mkv")
        ),
        *bags(folder),
        *robot_logs(),
        *animal_tracks(folder),
    ]


def rows(header: str, values: list[tuple[object, ...]], separator: str = ",") -> bytes:
    lines = [header] * bool(header) + [separator.join(map(str, row)) for row in values]
    return ("\n".join(lines) + "\n").encode()


def encoded(suffix: str, k: int) -> bytes:
    return cv2.imencode(suffix, picture(k) if suffix != ".pgm" else picture(k)[..., 0])[1].tobytes()


def saved(save: Callable[[io.BytesIO, np.ndarray], object]) -> bytes:
    file = io.BytesIO()
    save(file, np.cumsum(np.random.default_rng(0).normal(size=(N, 2)), axis=0))
    return file.getvalue()


def tarred(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as tar:
        for name, data in files.items():
            info = tarfile.TarInfo(f"frames/{name}")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    return out.getvalue()


def video(path: Path) -> bytes:
    code = {"avi": "MJPG", "mp4": "mp4v", "mkv": "FFV1"}[path.suffix[1:]]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 20.0, (64, 48))
    for k in range(N):
        writer.write(picture(k))
    writer.release()
    return path.read_bytes()


def tub(jpegs: dict[str, bytes]) -> dict[str, bytes]:
    records = [
        {"_index": k, "_timestamp_ms": 10**12 + 50 * k, "cam/image_array": name, "user/angle": 0.1}
        for k, name in enumerate(jpegs)
    ]
    about = {"paths": ["catalog_0.catalog"], "current_index": N, "deleted_indexes": [3]}
    return {
        "manifest.json": b"[]\n[]\n{}\n{}\n" + json.dumps(about).encode() + b"\n",
        "catalog_0.catalog": b"\n".join(json.dumps(one).encode() for one in records) + b"\n",
        **{f"images/{name}": data for name, data in jpegs.items()},
    }


def bags(folder: Path) -> list[Target]:
    """Make bags of ROS 1 and 2, of grey images and odometry."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    found = []
    for name in ("a.bag", "a.db3", "a.mcap"):
        first = name == "a.bag"
        store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
        t, path = store.types, folder / ("a.bag" if first else f"bag_{name[2:]}")
        plugin = StoragePlugin.SQLITE3 if name == "a.db3" else StoragePlugin.MCAP
        with Writer1(path) if first else Writer2(path, version=9, storage_plugin=plugin) as writer:
            kinds = {"/camera": "sensor_msgs/msg/Image", "/odom": "nav_msgs/msg/Odometry"}
            topics = {
                n: writer.add_connection(n, kind, typestore=store) for n, kind in kinds.items()
            }
            for k in range(N):
                stamp = t["builtin_interfaces/msg/Time"](1 + k, 0)
                seq = (k,) if first else ()
                header = t["std_msgs/msg/Header"](*seq, stamp, "map")
                image = t["sensor_msgs/msg/Image"](
                    header, 48, 64, "mono8", 0, 64, picture(k)[..., 0].reshape(-1)
                )
                place = t["geometry_msgs/msg/Pose"](
                    t["geometry_msgs/msg/Point"](0.1 * k, 0.0, 0.0),
                    t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                )
                vector = t["geometry_msgs/msg/Vector3"]
                twist = t["geometry_msgs/msg/Twist"](vector(0.1, 0.0, 0.0), vector(0.0, 0.0, 0.0))
                moved = t["nav_msgs/msg/Odometry"](
                    header,
                    "base",
                    t["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
                    t["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
                )
                serialize = store.serialize_ros1 if first else store.serialize_cdr
                for topic, message in (("/camera", image), ("/odom", moved)):
                    writer.write(topics[topic], (1 + k) * 10**9, serialize(message, kinds[topic]))
        file = path if first else next(path.glob(f"*{name[1:]}"))
        found.append(Target(f"bag {name[2:]}", {name: file.read_bytes()}, (name,), frames_of(name)))
    return found


def robot_logs() -> list[Target]:
    """Make logs of CARMEN, MRCLAM, landmark sightings, raw KITTI and TUM-VI."""
    beams = " ".join(["2.0"] * 19)
    carmen = "PARAM robot_frontlaser_offset 0.1 h 0\nODOM 0 0 0 0 0 0 0 h 0\n" + "".join(
        f"FLASER 19 {beams} {0.1 * k} 0 0 {0.1 * k} 0 0 {0.1 * k} h {0.1 * k}\n" for k in range(N)
    )
    laser = "".join(
        f"ROBOTLASER1 0 -1.57 3.14 0.174 30 0.01 0 19 {beams} 0 {0.1 * k} 0 0 {0.1 * k} 0 0"
        f" 0 0 0 0 0 {0.1 * k} h {0.1 * k}\n"
        for k in range(N)
    )
    mrclam = {
        "Robot1_Odometry.dat": rows("", [(0.1 * k, 0.5, 0.1) for k in range(N)], " "),
        "Robot1_Measurement.dat": rows("", [(0.1 * k, 72, 2.0, 0.5) for k in range(N)], " "),
        "Robot1_Groundtruth.dat": rows("", [(0.1 * k, 0.1 * k, 0, 0) for k in range(N)], " "),
        "Barcodes.dat": b"6 72\n1 5\n",
    }
    seen = rows("time_s,number,distance_m,bearing_rad", [(0.1 * k, 7, 2.0, 0.5) for k in range(N)])
    motion = rows("time_s,v_m_s,w_rad_s", [(0.1 * k, 0.5, 0.1) for k in range(N)])
    stamps = rows("", [(f"2011-09-26 13:02:{25 + 0.1 * k:.9f}",) for k in range(N)])
    poses = {
        f"oxts/data/{k:010d}.txt": f"{49 + 1e-6 * k} 8.4 112 0 0 0.5".encode() for k in range(N)
    }
    raw = {"image_02/timestamps.txt": stamps, "oxts/timestamps.txt": stamps, **poses}
    raw |= {f"image_02/data/{k:010d}.png": encoded(".png", k) for k in range(N)}
    vi = {f"mav0/cam0/data/{k}.jpg": encoded(".jpg", k) for k in range(N)}
    vi["mav0/cam0/data.csv"] = rows("#t,f", [(10**18 + 10**8 * k, f"{k}.jpg") for k in range(N)])
    vi["mav0/mocap0/data.csv"] = rows(
        "#t,x,y,z,w,x,y,z", [(10**18 + 10**8 * k, 0.1 * k, 0, 0, 1, 0, 0, 0) for k in range(N)]
    )
    axes = "".join(f"  - [{', '.join(['0.5'] * 4)}]\n" for _ in range(4))
    vi["dso/camchain.yaml"] = f"cam0:\n  T_cam_imu:\n{axes}".encode()
    in_mav = ("mav0/cam0/data.csv", "mav0/mocap0/data.csv", "dso/camchain.yaml")
    in_raw = ("image_02/timestamps.txt", "oxts/timestamps.txt", *list(poses)[:3])

    def both(folder: Path) -> None:
        for _ in open_source(f"{folder}/m.csv+{folder}/s.csv").frames(0, 3 * N, lambda _: None):
            pass

    return [
        Target("CARMEN FLASER", {"a.clf": carmen.encode()}, ("a.clf",), frames_of("a.clf"), True),
        Target(
            "CARMEN ROBOTLASER1", {"a.log": laser.encode()}, ("a.log",), frames_of("a.log"), True
        ),
        Target(
            "CARMEN gzip",
            {"a.log.gz": gzip.compress(carmen.encode())},
            ("a.log.gz",),
            frames_of("a.log.gz"),
        ),
        Target("MRCLAM folder", mrclam, tuple(mrclam), frames_of(""), True),
        Target("sightings CSV", {"m.csv": motion, "s.csv": seen}, ("s.csv",), both, True),
        Target("raw KITTI folder", raw, in_raw, frames_of(""), True),
        Target("TUM-VI folder", vi, in_mav, frames_of(""), True),
    ]


def animal_tracks(folder: Path) -> list[Target]:
    """Make tracks of animals as CSV, NPZ and NWB, and a record of cells."""
    turn = 0.1 * np.arange(N)
    path = np.column_stack([np.cos(turn), np.sin(turn)])
    header = "time_ms,x_cm,y_cm,hd_deg"
    table = rows(header, [(100 * k, *(100 * path[k]), 5.0 * k) for k in range(N)])
    arrays = {"pos": path, "t": turn, "hd": turn, "arena_radius": np.array(2.0)}
    saved_arrays = io.BytesIO()
    np.savez(saved_arrays, **arrays)
    log = ActivityLog.from_arrays(turn, path, {"grid": np.ones((N, 3))}, turn)
    nwb = {"a.nwb": log.to_nwb(folder / "a.nwb").read_bytes()}
    record("arena:square?minutes=0.01", only=["grid"], out=folder / "activity.zarr")
    zarr = {
        str(f.relative_to(folder)): f.read_bytes()
        for f in (folder / "activity.zarr").rglob("*") if f.is_file()
    }  # fmt: skip
    texts = tuple(name for name in zarr if name.endswith((".zarray", ".zattrs")))
    blocks = tuple(name for name in zarr if name not in texts)

    def track(name: str) -> Callable[[Path], None]:
        def read(at: Path) -> None:
            for _ in open_source(f"track:{at}/{name}").frames(0, 3 * N, lambda _fault: None):
                pass

        return read

    return [
        Target("track CSV", {"r.csv": table}, ("r.csv",), track("r.csv"), True),
        Target("track npz", {"r.npz": saved_arrays.getvalue()}, ("r.npz",), track("r.npz")),
        Target("track NWB", nwb, ("a.nwb",), track("a.nwb")),
        Target("activity, texts", zarr, texts, ActivityLog.open, True),
        Target("activity, blocks", zarr, (*texts, *blocks), ActivityLog.open),
    ]


def damage(data: bytes, is_text: bool, draw: np.random.Generator) -> bytes:
    """Return a damaged copy: one to four changes of one or several kinds."""
    changed = bytearray(data)
    for _ in range(int(draw.integers(1, 5))):
        at = int(draw.integers(0, max(len(changed), 1)))
        kinds = (
            ("token", "token", "line", "cut", "flip", "twice")
            if is_text
            else ("flip", "flip", "word", "word", "cut", "drop", "twice", "zeros", "head")
        )
        size = int(2 ** draw.uniform(0, 10))
        match str(draw.choice(kinds)):
            case "token":
                start = (
                    max(
                        changed.rfind(b" ", 0, at),
                        changed.rfind(b",", 0, at),
                        changed.rfind(b"\n", 0, at),
                    )
                    + 1
                )
                ends = [e for e in (changed.find(s, start) for s in (b",", b" ", b"\n")) if e >= 0]
                changed[start : min(ends, default=len(changed))] = TOKENS[
                    draw.integers(len(TOKENS))
                ]
            case "line":
                lines = changed.split(b"\n")
                k, other = draw.integers(len(lines), size=2)
                if draw.random() < 0.5:
                    lines[k], lines[other] = lines[other], lines[k]
                else:
                    del lines[k]
                changed = bytearray(b"\n".join(lines))
            case "cut":
                del changed[at:]
            case "flip" if changed:
                for k in draw.integers(0, len(changed), int(draw.integers(1, 9))):
                    changed[k] ^= 1 << int(draw.integers(8))
            case "word" | "head":
                at = (
                    at if draw.random() < 0.5 else int(draw.integers(0, min(len(changed), 256) + 1))
                )
                n, order = int(draw.choice((1, 2, 4, 8))), str(draw.choice(("big", "little")))
                value = WORDS[draw.integers(len(WORDS))] % 2 ** (8 * n)
                changed[at : at + n] = value.to_bytes(n, order)
            case "drop":
                del changed[at : at + size]
            case "twice":
                changed[at:at] = changed[at : at + size]
            case "zeros":
                changed[at : at + size] = bytes(min(size, len(changed) - at))
    return bytes(changed)
