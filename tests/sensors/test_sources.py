import gzip
import io
import pickle
import subprocess
import sys
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neuroslam.errors import BadFrame, SourceError
from neuroslam.geometry import integrate_velocities
from neuroslam.sensors import open_source
from neuroslam.sensors.images import decode_grey, natural_key, parse_image_list
from neuroslam.sensors.open import absolute_spec
from neuroslam.sensors.tracks import motion_along
from neuroslam.types import Frame, Pose, Velocity

W, H = 32, 24


def random_image(seed: int, width: int = W, height: int = H) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height))


def encoded(seed: int, suffix: str = ".png", **size: int) -> bytes:
    return cv2.imencode(suffix, random_image(seed, **size))[1].tobytes()


def grey(seed: int) -> np.ndarray:
    return cv2.cvtColor(random_image(seed), cv2.COLOR_BGR2GRAY)


def fill(folder: Path, n: int, suffix: str = ".png") -> Path:
    folder.mkdir(exist_ok=True)
    for i in range(n):
        (folder / f"{i}{suffix}").write_bytes(encoded(i, suffix))
    return folder


def pack(tar: Path, files: dict[str, bytes], mode: str = "w") -> Path:
    with tarfile.open(tar, mode) as out:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            out.addfile(member, io.BytesIO(data))
    return tar


def film(path: Path, n: int, code: str = "MJPG", fps: float = 12.5) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), fps, (64, 48))
    for i in range(n):
        writer.write(random_image(i, 64, 48))
    writer.release()
    return path


def same_frames(ours, theirs) -> bool:
    return [f._replace(image=None) for f in ours] == [f._replace(image=None) for f in theirs] and (
        all(np.array_equal(a.image, b.image) for a, b in zip(ours, theirs, strict=True))
    )


def refused(spec: object, **options: float) -> str:
    """Return the one line with which a source is refused, on opening or on the way."""
    with pytest.raises(SourceError) as caught:
        list(open_source(spec, **options))
    assert "\n" not in str(caught.value)
    return str(caught.value)


# Images


def test_a_speed_upwards_is_a_column_of_a_motion_csv(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("time_s,v_m_s,w_rad_s,v_z_m_s\n0,1,0,0.5\n0.1,1,0,\n0.2,1,0,-0.25\n")
    assert [f.v_z_m_s for f in open_source(file)] == [0.5, None, -0.25]


def test_a_gyroscope_is_a_column_of_a_motion_csv(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("time_s,v_m_s,w_rad_s,gyro_rad_s\n0,1,0,0.1\n0.1,1,0,\n0.2,1,0,-0.3\n")
    assert [f.turn_rate_rad_s for f in open_source(file)] == [0.1, None, -0.3]
    file.write_text("time_s,v_m_s,w_rad_s\n0,1,0\n0.1,1,0\n")
    assert [f.turn_rate_rad_s for f in open_source(file)] == [None, None]


def test_images_come_in_the_natural_order_of_their_names(tmp_path):
    frames = list(open_source(fill(tmp_path / "f", 11), frame_rate_hz=4.0))
    assert [f.index for f in frames] == list(range(11))
    assert [f.time_s for f in frames] == [i / 4.0 for i in range(11)]
    assert all(np.array_equal(f.image, grey(f.index)) for f in frames)
    assert frames[0].image.dtype == np.uint8
    assert frames[0].image.shape == (H, W)


@given(st.permutations([0, 2, 9, 10, 11, 100]))
def test_natural_order_does_not_depend_on_the_order_before(numbers):
    names = [f"cam1/img{i}.jpg" for i in numbers]
    assert sorted(names, key=natural_key) == [f"cam1/img{i}.jpg" for i in sorted(numbers)]


@pytest.mark.parametrize("mode", ["w", "w:gz", "w:xz"])
def test_a_tar_gives_the_frames_of_its_folder_whatever_order_it_was_packed_in(tmp_path, mode):
    folder = fill(tmp_path / "f", 11, ".jpg")
    (folder / "times.txt").write_text("\n".join(str(0.1 * i) for i in range(11)))
    files = {f"f/{p.name}": p.read_bytes() for p in sorted(folder.iterdir(), reverse=True)}
    files["f/._3.jpg"] = b"what macOS adds"
    tar = pack(tmp_path / f"f.tar{mode[1:].replace(':', '.')}", files, mode)
    ours = list(open_source(tar))
    assert same_frames(ours, list(open_source(folder)))
    assert ours[3].time_s == pytest.approx(0.3)
    assert same_frames(list(open_source(tar).frames(5, 8)), ours[5:8])


def test_frames_of_the_track_are_what_the_reference_saw(shared):
    source = open_source(shared / "data" / "circuit_launch" / "frames.tar")
    assert (source.n_frames, source.frame_rate_hz) == (1000, 20.0)
    with tarfile.open(shared / "data" / "circuit_launch" / "frames.tar") as tar:
        data = np.frombuffer(tar.extractfile("000777.jpg").read(), np.uint8)
    colour = cv2.imdecode(data, cv2.IMREAD_COLOR)
    (frame,) = source.frames(777, 778)
    assert frame.time_s == 777 / 20.0
    assert np.array_equal(frame.image, cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


def test_a_folder_may_hold_the_motion_of_its_frames(tmp_path):
    folder = fill(tmp_path / "f", 2)
    (folder / "odometry.csv").write_text(
        "time_s,v_m_s,w_rad_s,x_m,y_m,theta_rad\n10,1,0.5,0,0,0\n10.5,2,-0.5,1,2,3\n"
    )
    first, second = open_source(folder)
    assert (first.time_s, second.time_s) == (10.0, 10.5)
    assert second.velocity == Velocity(2.0, -0.5)
    assert second.truth == Pose(1.0, 2.0, 3.0)
    assert np.array_equal(second.image, grey(1))


def test_a_list_names_images_and_times(tmp_path):
    fill(tmp_path / "f g", 3)
    (tmp_path / "list.csv").write_text("time,path\n0.5,f g/2.png\n0.75,f g/0.png\n")
    (tmp_path / "list.txt").write_text("# time last\nf g/2.png 0.5\n\nf g/0.png 0.75\n")
    (tmp_path / "untimed.txt").write_text("f g/2.png\nf g/0.png\n")
    table = list(open_source(tmp_path / "list.csv"))
    assert [f.time_s for f in table] == [0.5, 0.75]
    assert np.array_equal(table[0].image, grey(2))
    assert same_frames(table, list(open_source(tmp_path / "list.txt")))
    assert [f.time_s for f in open_source(tmp_path / "untimed.txt", 2.0)] == [0.0, 0.5]


@given(st.floats(0, 1e6), st.sampled_from(["a.png", "x/y z.jpg", "12.5.png"]), st.booleans())
def test_time_and_path_of_a_list_may_come_in_either_order(time_s, path, comma):
    separator = "," if comma else " "
    assert parse_image_list(f"{time_s!r}{separator}{path}", "l") == [(path, time_s)]
    assert parse_image_list(f"{path}{separator}{time_s!r}", "l") == [(path, time_s)]


def test_grey_is_made_from_colour_as_a_jpeg_decoded_to_grey_differs():
    data = encoded(3, ".jpg")
    colour = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decode_grey(data), cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))


# What goes wrong with images


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".bmp", ".tif", ".webp"])
@pytest.mark.parametrize("fault", ["cut", "text", "empty"])
def test_a_corrupt_image_is_named_and_may_be_left_out(tmp_path, capfd, suffix, fault):
    folder = fill(tmp_path / "f", 4, suffix)
    data = (folder / f"2{suffix}").read_bytes()
    damaged = {"cut": data[: len(data) * 3 // 5], "text": b"not an image" * 9, "empty": b""}
    (folder / f"2{suffix}").write_bytes(damaged[fault])
    source, delivered = open_source(folder), []
    with pytest.raises(BadFrame, match=rf"frame 2: 2\{suffix} is corrupt or not an image"):
        delivered.extend(source)
    faults = []
    rest = source.frames(on_bad_frame=faults.append)
    assert [f.index for f in rest] == [0, 1, 3]
    assert len(faults) == 1
    assert capfd.readouterr().err == ""


def test_a_damaged_png_is_refused_without_a_word_of_the_decoder(tmp_path, capfd):
    folder = fill(tmp_path / "f", 3)
    data = bytearray(encoded(1))
    data[len(data) // 2] ^= 0xFF
    (folder / "1.png").write_bytes(data)
    assert "frame 1: 1.png is corrupt" in refused(folder)
    assert capfd.readouterr().err == ""


def test_a_change_of_size_is_reported_with_both_sizes_wherever_one_starts(tmp_path):
    folder = fill(tmp_path / "f", 4)
    (folder / "2.png").write_bytes(encoded(2, width=40, height=30))
    message = refused(folder)
    assert "frame 2 (2.png) is 40 x 30 px; expected 32 x 24 px" in message
    with pytest.raises(BadFrame, match="frame 2"):
        list(open_source(folder).frames(start=2))
    assert [f.index for f in open_source(folder).frames(1, 4, [].append)] == [1, 3]


def test_a_folder_without_images_or_with_none_that_decode_is_refused(tmp_path):
    (tmp_path / "notes.md").write_text("nothing")
    assert "contains no images" in refused(tmp_path)
    (tmp_path / "a.jpg").write_text("nothing")
    fault = "frame 0: a.jpg is corrupt or not an image"
    assert refused(tmp_path).endswith(fault)
    (tmp_path / "b.jpg").write_text("nothing")
    assert refused(tmp_path).endswith(f"{fault}; and so are all 2 frames")


def test_times_and_motion_must_be_as_many_as_images(tmp_path):
    folder = fill(tmp_path / "f", 3)
    (folder / "times.csv").write_text("time_s\n0\n1\n")
    assert "2 times for 3 images; expected one per image" in refused(folder)
    (folder / "times.csv").write_text("0\n1\nsoon\n")
    assert "times.csv: line 3 is 'soon'; expected a time in seconds" in refused(folder)
    (folder / "times.csv").unlink()
    (folder / "odometry.csv").write_text("v_m_s,w_rad_s\n1,0\n")
    assert "1 lines of motion" in refused(folder)


@pytest.mark.parametrize(
    ("times", "fault"),
    [
        ("0\n1\n0.5\n2", "frame 2: its time 0.5 s is not after 1 s"),
        ("0\n1\n1\n2", "frame 2: its time 1 s is not after 1 s"),
        ("0\n1\nnan\n2", "frame 2: its time is nan"),
        ("0\n1\ninf\n2", "frame 2: its time is inf"),
    ],
)
def test_times_that_do_not_rise_are_named_and_may_be_left_out(tmp_path, times, fault):
    folder = fill(tmp_path / "f", 4)
    (folder / "times.txt").write_text(times)
    assert fault in refused(folder)
    faults = []
    assert [f.time_s for f in open_source(folder).frames(on_bad_frame=faults.append)] == [0, 1, 2]
    assert [fault in str(f) for f in faults] == [True]


def test_a_list_that_cannot_be_used_says_which_line(tmp_path):
    fill(tmp_path / "f", 2)
    path = tmp_path / "list.txt"
    path.write_text("0 f/0.png\nf/1.png\n")
    assert "f/1.png has no time, but others do" in refused(path)
    path.write_text("0 f/0.png\n1 f/9.png\n")
    assert "frame 1: f/9.png cannot be read (No such file or directory)" in refused(path)
    path.write_text("0 f/0.png\nwhat is this.\n")
    assert "line 2 is 'what is this.'" in refused(path)


def test_a_damaged_tar_is_refused(tmp_path):
    files = {f"{i}.png": encoded(i) for i in range(4)}
    whole = pack(tmp_path / "whole.tar", files).read_bytes()
    (tmp_path / "cut.tar").write_bytes(whole[:2500])
    assert "cut.tar: is damaged or incomplete" in refused(tmp_path / "cut.tar")
    (tmp_path / "cut.tar.gz").write_bytes(gzip.compress(whole)[:900])
    assert "cut.tar.gz: is damaged or incomplete" in refused(tmp_path / "cut.tar.gz")
    (tmp_path / "text.tar").write_text("hello")
    assert "text.tar: is damaged or incomplete" in refused(tmp_path / "text.tar")
    pack(tmp_path / "none.tar", {"a.txt": b"hello"})
    assert "none.tar: contains no images" in refused(tmp_path / "none.tar")


# Video


def test_a_video_gives_every_frame_at_the_rate_of_its_container(tmp_path):
    source = open_source(film(tmp_path / "a.avi", 7))
    assert (source.n_frames, source.frame_rate_hz) == (7, 12.5)
    frames = list(source)
    assert [f.time_s for f in frames] == [i / 12.5 for i in range(7)]
    assert all(f.image.shape == (48, 64) for f in frames)
    assert (
        np.abs(frames[4].image - cv2.cvtColor(random_image(4, 64, 48), 6).astype(float)).mean() < 4
    )


@pytest.mark.parametrize(
    ("name", "code"), [("a.avi", "MJPG"), ("b.mp4", "mp4v"), ("c.mkv", "mp4v")]
)
def test_a_video_read_from_the_middle_gives_the_frames_it_gives_from_the_start(
    tmp_path, name, code
):
    source = open_source(film(tmp_path / name, 30, code))
    whole = list(source)
    assert len(whole) == 30
    assert same_frames(list(source.frames(13, 22)), whole[13:22])
    assert list(source.frames(30)) == []


def test_a_truncated_video_gives_what_there_is_and_then_says_so(tmp_path):
    data = film(tmp_path / "a.avi", 30).read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(data[: len(data) * 3 // 5])
    delivered = []
    with pytest.raises(BadFrame, match=r"is missing; expected 30 frames, as the container states"):
        delivered.extend(open_source(cut))
    assert 10 < len(delivered) < 30
    assert same_frames(delivered[:10], list(open_source(tmp_path / "a.avi").frames(0, 10)))
    faults = []
    assert len(list(open_source(cut).frames(on_bad_frame=faults.append))) == len(delivered)
    assert [f"frame {len(delivered)} is missing" in str(f) for f in faults] == [True]
    assert len(list(open_source(cut).frames(stop=10))) == 10


def test_a_damaged_video_makes_no_decoder_print(tmp_path):
    data = film(tmp_path / "a.avi", 30).read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) * 3 // 5])
    (tmp_path / "text.mp4").write_text("hello")
    code = """
import sys
from neuroslam.sensors import open_source
for path in sys.argv[1:]:
    try:
        list(open_source(path))
    except ValueError as error:
        print(error)
"""
    # Another process: FFmpeg reads its log level once, on first use.
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "cut.avi", tmp_path / "text.mp4"],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    assert len(done.stdout.splitlines()) == 2
    assert done.stderr == ""


def test_what_is_not_a_video_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.mp4").write_text("hello")
    (tmp_path / "empty.avi").touch()
    data = film(tmp_path / "a.mp4", 9, "mp4v").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    for name in ("text.mp4", "empty.avi", "cut.mp4"):
        assert f"{name}: cannot be read; expected a complete video file" in refused(tmp_path / name)


def test_a_video_of_no_frames_is_refused(tmp_path):
    data = film(tmp_path / "a.avi", 1).read_bytes()
    head = data[: data.index(b"movi") + 4]
    (tmp_path / "none.avi").write_bytes(head)
    assert "none.avi: no frame can be decoded" in refused(tmp_path / "none.avi")


# Motion and tracks


def test_the_references_motion_is_read_to_the_last_digit(shared):
    source = open_source(shared / "data" / "usi_track1" / "odometry_vo.csv")
    frames = list(source)
    assert source.n_frames == len(frames) == 2873
    assert frames[0].velocity == Velocity(5.0, -9.3593281138195916)
    assert frames[1] == Frame(1, 0.05, velocity=Velocity(0.24733893557422978, 0.0))


def test_a_motion_table_may_hold_times_truth_and_columns_of_no_meaning_here(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text(
        "frame, V_m_s ,w_rad_s,time_s,x_m,y_m,theta_rad\n0,1,2,0.5,3,4,5\n\n1,6,7,0.75,,,\n"
    )
    first, second = open_source(path)
    assert first == Frame(0, 0.5, velocity=Velocity(1, 2), truth=Pose(3, 4, 5))
    assert second == Frame(1, 0.75, velocity=Velocity(6, 7))


def test_motion_that_is_not_finite_is_named_by_its_line_and_may_be_left_out(tmp_path):
    path = tmp_path / "m.csv"
    for wrong in ("nan", "inf", ""):
        path.write_text(f"v_m_s,w_rad_s\n1,0\n\n{wrong},0.5\n1,0\n")
        message = refused(path)
        assert "m.csv: frame 1 (line 4): its motion is v = " in message
        assert [f.index for f in open_source(path).frames(on_bad_frame=[].append)] == [0, 2]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "is empty; expected v_m_s,w_rad_s (or vtrans,vrot)"),
        ("\n\n", "is empty"),
        ("v_m_s,w_rad_s\n", "has a header, but no lines"),
        ("speed,turn\n1,2\n", "has the columns speed,turn, but no v_m_s; expected v_m_s,w_rad_s"),
        ("1,2\n3,4\n", "has the columns 1,2, but no v_m_s"),
        ("v_m_s,w_rad_s,x_m\n1,2,3\n", "no y_m"),
        ("v_m_s,w_rad_s\n1,2\n1\n", "line 3 has 1 values; expected 2"),
        ("v_m_s,w_rad_s\n1,fast\n", "line 2: w_rad_s is 'fast'; expected a number"),
        ("time_s,v_m_s,w_rad_s\n1,0,0\n0,0,0\n", "frame 1: its time 0 s is not after 1 s"),
        ("time_s,v_m_s,w_rad_s\n1,0,0\n,0,0\n", "frame 1: its time is nan"),
    ],
)
def test_a_motion_table_that_cannot_be_used_says_why(tmp_path, text, fault):
    (tmp_path / "m.csv").write_text(text)
    message = refused(tmp_path / "m.csv")
    assert "m.csv" in message
    assert fault in message


def test_a_table_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "m.csv").write_bytes(b"\xff\xfe\x00\x80" * 9)
    assert "m.csv: is not a text file" in refused(tmp_path / "m.csv")


@given(
    arrays(np.float64, st.tuples(st.integers(1, 30), st.just(2)), elements=st.floats(-9, 9)),
    st.floats(0.01, 2.0),
)
def test_dead_reckoning_the_motion_of_a_track_gives_the_track_again(positions, dt):
    times = np.arange(len(positions)) * dt
    velocities, poses = motion_along(times, positions)
    walked = integrate_velocities(*velocities.T, np.full(len(times), dt), Pose(*poses[0]))
    np.testing.assert_allclose(walked[:, :2], positions, atol=1e-9)
    np.testing.assert_allclose(np.cos(walked[:, 2] - poses[:, 2]), 1.0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "n", "rate"),
    [("rodent/hafting2005_circle2m.npz", 29552, 50.0), ("two_rooms/twoRooms_path.npy", 60000, 1e3)],
)
def test_real_tracks_become_motion_that_leads_along_them(shared, name, n, rate):
    source = open_source(shared / "data" / name, frame_rate_hz=1000.0)
    assert source.n_frames == n
    assert source.frame_rate_hz == pytest.approx(rate)
    frames = list(source.frames(1000, 3000))
    motion = np.array([f.velocity for f in frames])
    truth = np.array([f.truth for f in frames])
    steps = np.diff([f.time_s for f in frames])
    walked = integrate_velocities(*motion[1:].T, steps, frames[0].truth)
    np.testing.assert_allclose(walked[:, :2], truth[1:, :2], atol=1e-6)


def test_a_position_that_is_missing_is_left_out_and_the_motion_spans_the_gap(tmp_path):
    positions = np.array([[0.0, 0], [1, 0], [np.nan, 0], [3, 0]])
    np.savez(tmp_path / "t.npz", t=np.arange(4) * 0.5, pos=positions)
    assert "frame 2 (row 2)" in refused(tmp_path / "t.npz")
    frames = list(open_source(tmp_path / "t.npz").frames(on_bad_frame=[].append))
    assert [f.index for f in frames] == [0, 1, 3]
    assert frames[2].velocity == Velocity(2.0, 0.0)  # 2 m in the 1 s since the frame before it


def test_a_track_that_cannot_be_used_says_why(tmp_path):
    path = tmp_path / "t.npz"
    np.savez(path, t=np.arange(3.0), where=np.zeros((3, 2)))
    assert "has the arrays t, where; expected pos (n, 2) in metres and t (n,)" in refused(path)
    np.savez(path, t=np.arange(3.0), pos=np.zeros((4, 2)))
    assert "pos is (4, 2), t is (3,); expected numbers, pos (n, 2)" in refused(path)
    np.savez(path, t=np.arange(0.0), pos=np.zeros((0, 2)))
    assert "n above 0" in refused(path)
    np.savez(path, t=np.arange(3.0), pos=np.zeros((3, 2)))
    path.write_bytes(path.read_bytes()[:300])
    assert "t.npz: is damaged or incomplete" in refused(path)
    path.write_bytes(b"")
    assert "t.npz: is damaged or incomplete" in refused(path)


class Trap:
    def __reduce__(self):
        return (Path.touch, (Path("sprung"),))


def test_pickles_are_refused_and_not_loaded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("t.npz")
    boxed = np.array([Trap()], dtype=object)
    np.savez(path, t=np.arange(3.0), pos=np.zeros((3, 2)), more=boxed)
    assert refused(path) == (
        "t.npz: contains pickled objects, which are never loaded; expected plain arrays"
    )
    path.write_bytes(pickle.dumps(Trap()))
    assert "t.npz: contains pickled objects" in refused(path)
    assert not Path("sprung").exists()


# Opening


@pytest.mark.parametrize("name", ["trash.npz", "trash.npy"])
def test_what_numpy_did_not_write_is_not_called_a_pickle(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"xx")
    assert refused(path) == (f"{path}: is not an .npz or .npy file; expected one written by numpy")


def test_an_address_is_reported_as_typed_and_stays_unchanged():
    address = "http://example.com/x.mp4"
    assert refused(address).startswith(
        f"{address}: is an address; open it as a camera: camera:http"
    )
    assert absolute_spec(address) == address


def test_what_is_missing_or_of_no_known_kind_is_refused(tmp_path):
    assert "nowhere.avi: no such file or folder; expected a video" in refused("nowhere.avi")
    (tmp_path / "a.doc").write_text("hello")
    assert "a.doc: is of no known kind; expected a video" in refused(tmp_path / "a.doc")
    (tmp_path / "a.png").write_bytes(encoded(0))
    assert "a.png: is a single image; expected a video, a folder" in refused(tmp_path / "a.png")
    for rate in (0.0, -1.0, float("nan"), float("inf")):
        assert "frame rate is" in refused(tmp_path, frame_rate_hz=rate)


def test_a_rendered_world_is_a_source_like_the_others():
    source = open_source("world:corridor?laps=1")
    assert next(iter(source.frames(7, 8, [].append))).index == 7
    assert "world 'nowhere': no such world" in refused("world:nowhere")


def test_reading_a_source_twice_gives_the_same_and_stop_cuts_it(tmp_path):
    source = open_source(fill(tmp_path / "f", 5))
    assert same_frames(list(source), list(source.frames()))
    assert [f.index for f in source.frames(1, 3)] == [1, 2]
    assert [f.index for f in source.frames(3, 99)] == [3, 4]
    assert list(source.frames(5)) == []


def test_a_table_of_positions_is_the_track_of_an_animal(tmp_path):
    path = tmp_path / "rat.csv"
    path.write_text("time_ms,x_cm,y_cm\n0,0,0\n500,10,0\n1000,10,20\n")
    positions = open_source(path).walk.positions
    np.testing.assert_allclose(positions, [[0.0, 0.0], [0.1, 0.0], [0.1, 0.2]])


def test_a_misspelt_path_and_the_folder_of_a_run_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "drive.mp4").touch()
    assert "drvie.mp4: no such file or folder; did you mean 'drive.mp4'?" in refused(
        tmp_path / "drvie.mp4"
    )
    for name in ("brain.safetensors", "config.toml", "map.png"):
        (tmp_path / name).touch()
    said = refused(tmp_path)
    assert "is the folder of a run, not a recording; expected what it was made from" in said
    assert said.endswith(f"neuroslam resume {tmp_path}")
