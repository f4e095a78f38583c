"""Damaged and malicious sources: read, or refused in one line, within bounds of memory."""

import gzip
import io
import json
import os
import struct
import tarfile
import zipfile
import zlib

import cv2
import numpy as np
import pytest

from neuroslam.errors import BadFrame, SourceError
from neuroslam.limits import MAX_MEMORY, MOST_PIXELS, budget_bytes, free_bytes
from neuroslam.sensors import open_source
from neuroslam.sensors.image_size import image_size
from neuroslam.sensors.images import decode

MB = 2**20


@pytest.fixture
def budget(monkeypatch):
    return lambda text: monkeypatch.setenv(MAX_MEMORY, text)


def refusal(path) -> str:
    with pytest.raises(SourceError) as caught:
        list(open_source(path).frames())
    assert "\n" not in str(caught.value)
    return str(caught.value)


def picture(k=0, size=(64, 48)):
    coarse = np.random.default_rng(k).integers(0, 255, (6, 8, 3), np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST)


def encoded(suffix, image=None):
    return cv2.imencode(suffix, picture() if image is None else image)[1].tobytes()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def grey_png(width, height):
    """Return a PNG of zeros that states a size."""
    rows = zlib.compress(bytes(1000), 9)
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


class Zeros(io.RawIOBase):
    def __init__(self, n):
        self.n = n

    def read(self, size=-1):
        size = self.n if size < 0 else min(size, self.n)
        self.n -= size
        return bytes(size)


def tar_of_zeros(path, name, n):
    with (
        gzip.open(path, "wb", compresslevel=1) as packed,
        tarfile.open(fileobj=packed, mode="w|") as tar,
    ):
        info = tarfile.TarInfo(name)
        info.size = n
        tar.addfile(info, Zeros(n))
    return path


# --- budgets -------------------------------------------------------------------------------------


def test_the_budget_is_half_of_what_is_free_or_what_is_set(budget):
    assert 0 < budget_bytes() <= free_bytes()
    budget("1.5G")
    assert budget_bytes() == 3 * 2**29


def test_the_given_sparse_tar_is_refused_before_it_fills_memory(cases):
    found = refusal(cases / "hostile" / "sparse-tar-bomb" / "sp3.tar.gz")
    assert "0.jpg is sparse; expected a whole file" in found


@pytest.mark.parametrize("name", ["0.png", "0.dat"])
def test_a_tar_that_unpacks_to_hundreds_of_its_size_is_refused(name, tmp_path):
    path = tar_of_zeros(tmp_path / "bomb.tar.gz", name, 260 * MB)
    assert path.stat().st_size < 3 * MB
    assert "MB become more than" in refusal(path)


def test_a_tar_with_more_than_the_budget_is_refused_and_read_with_more(tmp_path, budget):
    noise = np.random.default_rng(0).integers(0, 255, (600, 600, 3), np.uint8)
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as tar:
        for k in range(3):
            data = encoded(".png", noise)
            info = tarfile.TarInfo(f"{k}.png")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    budget("2M")
    assert "needs about 2 MB; expected at most 2 MB of memory, see --max-memory" in refusal(
        tmp_path / "a.tar.gz"
    )
    budget("100M")
    assert len(list(open_source(tmp_path / "a.tar.gz"))) == 3


@pytest.mark.parametrize("packed", ["xz", "bz2", "gz"])
def test_compressed_tars_are_read(packed, tmp_path):
    with tarfile.open(tmp_path / f"a.tar.{packed}", f"w:{packed}") as tar:
        for k in range(3):
            data = encoded(".png", picture(k))
            info = tarfile.TarInfo(f"{k}.png")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    images = [frame.image for frame in open_source(tmp_path / f"a.tar.{packed}")]
    assert [image.shape for image in images] == [(48, 64)] * 3


def test_an_npz_that_unpacks_to_hundreds_of_its_size_is_refused(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("pos.npy", "w") as file,
    ):
        shape = {"descr": "<f8", "fortran_order": False, "shape": (20 * MB, 2)}
        np.lib.format.write_array_header_1_0(file, shape)
        for _ in range(20):
            file.write(bytes(16 * MB))
    assert "become 320 MB; expected an array of positions" in refusal(tmp_path / "a.npz")


def test_an_array_above_the_budget_is_refused(tmp_path, budget):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(100_000, 2)))
    budget("4M")
    assert "needs about 6 MB; expected at most 4 MB" in refusal(tmp_path / "a.npy")


def test_a_picture_of_900_megapixels_is_refused_by_its_header(tmp_path):
    folder = tmp_path / "png"
    folder.mkdir()
    (folder / "0.png").write_bytes(grey_png(30_000, 30_000))
    assert f"0.png is 30,000 x 30,000 px; expected at most {MOST_PIXELS:,} px" in refusal(folder)


def test_the_budget_holds_for_pictures_too(tmp_path, budget):
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "0.png").write_bytes(grey_png(1000, 1000))
    budget("10M")
    assert "1,000 x 1,000 px, which needs about 15 MB" in refusal(tmp_path / "f")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif", ".webp", ".ppm"])
def test_the_size_of_an_image_is_that_of_its_pixels(suffix):
    for size in ((64, 48), (301, 7)):
        data = encoded(suffix, picture(1, size))
        assert image_size(data) == size[::-1] == decode(data).shape[1::-1][::-1]
        assert image_size(data[:5]) is None
    assert image_size(encoded(".pgm", picture()[..., 0])) == (48, 64)


@pytest.mark.parametrize("flags", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]])
def test_the_size_of_a_jpeg_is_found_behind_other_segments(flags):
    plain = cv2.imencode(".jpg", picture(), flags)[1].tobytes()
    comment = b"\xff\xfe" + struct.pack(">H", 1002) + b"\xff\xc0" * 500
    assert image_size(plain[:2] + comment + plain[2:]) == (48, 64)


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/stdin"])
def test_a_device_in_an_image_list_is_no_image(device, tmp_path):
    (tmp_path / "list.txt").write_text(f"0.0 {device}\n0.1 1.png\n")
    assert "is a device or a pipe; expected a regular file" in refusal(tmp_path / "list.txt")


# --- texts ---------------------------------------------------------------------------------------

HEAD = "time_s,v_m_s,w_rad_s\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "0,1,0\n0.1," + "9" * 200_000 + ",0\n", "field larger than field limit"),
        (HEAD + '0,"1,0\n' + "0.1,1,0\n" * 20_000, "field larger than field limit"),
        (HEAD + "0,1,0\r0.1,1,0\r\r\n0.2,1,0", "new-line character seen in unquoted field"),
        (HEAD + "0,1\0,0\n", "line 2"),
        (HEAD + "0," + "9" * 5000 + ",0\n", "expected finite numbers"),
    ],
)
def test_a_table_that_cannot_be_parsed_is_one_line(text, message, tmp_path):
    (tmp_path / "m.csv").write_text(text, newline="")
    assert message in refusal(tmp_path / "m.csv")


def test_a_name_of_thousands_of_digits_has_an_order(tmp_path):
    with tarfile.open(tmp_path / "a.tar", "w") as tar:
        for name in ("1" * 5000, "2", "1"):
            data = encoded(".png")
            info = tarfile.TarInfo(f"frames_{name}.png")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    names = [image.name for image in open_source(tmp_path / "a.tar").images]
    assert names[:2] == ["frames_1.png", "frames_2.png"]


@pytest.mark.parametrize("case", ["traceback_npz_npy/a.npy", "traceback_image_list/list.txt"])
def test_the_given_damaged_sources_are_one_line(case, cases):
    assert refusal(cases / "hostile" / case)


def test_the_given_damaged_bag_is_one_line(cases):
    assert "expected a ROS bag" in refusal(cases / "hostile" / "traceback_bag_b2.db3" / "b2.db3")


@pytest.mark.parametrize("header", ["{'descr': '<f8', 'shape': (", "[" * 9000, "{1: " * 3000])
def test_a_damaged_header_of_an_array_is_one_line(header, tmp_path):
    data = header.encode().ljust(118 if len(header) < 118 else len(header) + 1)
    head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(data)) + data
    (tmp_path / "a.npy").write_bytes(head + bytes(400))
    assert "a.npy" in refusal(tmp_path / "a.npy")


# --- damaged pictures of a video -----------------------------------------------------------------


def motion_jpeg(path, n=20):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (160, 120))
    for k in range(n):
        writer.write(picture(k, (160, 120)))
    writer.release()
    return bytearray(path.read_bytes())


def chunks(data):
    """Return where the pictures of an AVI begin, and their sizes."""
    at, found = data.index(b"movi") + 4, []
    while data[at : at + 4] in (b"00dc", b"JUNK"):
        size = int.from_bytes(data[at + 4 : at + 8], "little")
        found += [(at + 8, size)] if data[at : at + 4] == b"00dc" else []
        at += 8 + size + size % 2
    return found


DAMAGE = {
    "half of it is zeros": lambda data, at, size: data.__setitem__(
        slice(at + size // 2, at + size), bytes(size - size // 2)
    ),
    "all of it is zeros": lambda data, at, size: data.__setitem__(
        slice(at, at + size), bytes(size)
    ),
    "its head is zeros": lambda data, at, _size: data.__setitem__(
        slice(at + 2, at + 300), bytes(298)
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("numbers", [[0], [9], [9, 10, 14]])
def test_damaged_pictures_are_counted_and_the_others_keep_their_times(damage, numbers, tmp_path):
    path = tmp_path / "v.avi"
    data = motion_jpeg(path)
    for number in numbers:
        DAMAGE[damage](data, *chunks(data)[number])
    path.write_bytes(data)
    faults: list[BadFrame] = []
    frames = list(open_source(path).frames(0, None, faults.append))
    assert len(frames) + len(faults) == 20
    assert len(faults) == len(numbers)
    for fault, number in zip(faults, numbers, strict=True):
        assert f"frame {number} is " in str(fault)
    good = [k for k in range(20) if k not in numbers]
    np.testing.assert_allclose([f.time_s for f in frames], np.array(good) / 20.0, atol=1e-6)
    assert [f.index for f in frames] == good


def test_a_whole_video_has_no_faults_and_part_of_it_is_that_part(tmp_path):
    motion_jpeg(tmp_path / "v.avi")
    assert [f.index for f in open_source(tmp_path / "v.avi").frames(3, 7)] == [3, 4, 5, 6]
    assert len(list(open_source(tmp_path / "v.avi"))) == 20


def test_a_damaged_picture_stops_a_run_and_is_counted_if_skipped(tmp_path, call):
    path = tmp_path / "v.avi"
    data = motion_jpeg(path)
    DAMAGE["half of it is zeros"](data, *chunks(data)[9])
    path.write_bytes(data)
    done = call("run", path, "-o", tmp_path / "a", "--no-tensorboard")
    assert done.code == 2
    assert "frame 9 is cut short; to leave out such frames: --on-bad-frame skip" in done.err
    done = call("run", path, "-o", tmp_path / "b", "--no-tensorboard", "--on-bad-frame", "skip")
    assert done.code == 0
    assert f"skipped: {path}: frame 9 is cut short" in done.err


# --- tubs, and names -----------------------------------------------------------------------------


def test_the_given_tub_is_read_with_its_times_and_controls(cases, tmp_path):
    with tarfile.open(cases / "donkeycar_tub" / "tub.tar.gz") as tar:
        tar.extractall(tmp_path, filter="data")
    source = open_source(tmp_path / "tub")
    frames = list(source)
    assert [f.index for f in frames] == list(range(12))
    assert frames[0].time_s == 1668211865.372
    assert frames[2].time_s == 1668211865.473
    assert source.controls.shape == (12, 2)
    np.testing.assert_allclose(source.controls[2], [-0.27353740043336283, 0.4])


def tub(folder, records, about):
    (folder / "images").mkdir(parents=True)
    for k in range(9):
        (folder / "images" / f"{k}.jpg").write_bytes(encoded(".jpg", picture(k)))
    (folder / "manifest.json").write_text(f"[]\n[]\n{{}}\n{{}}\n{about}\n")
    (folder / "catalog_7.catalog").write_text("\n".join(records) + "\n")
    return folder


def record(k, more=""):
    return (
        f'{{"_index": {k}, "_timestamp_ms": {1000 + 50 * k}, "cam/image_array": "{k}.jpg"{more}}}'
    )


def test_a_tub_is_in_the_order_of_its_index_without_deleted_records(tmp_path):
    about = '{"paths": ["catalog_7.catalog"], "deleted_indexes": [2, 3]}'
    source = open_source(tub(tmp_path / "t", [record(k) for k in (5, 2, 0, 3, 4, 1)], about))
    assert [image.name for image in source.images] == ["0.jpg", "1.jpg", "4.jpg", "5.jpg"]
    assert [f.time_s for f in source] == [1.0, 1.05, 1.2, 1.25]
    assert np.isnan(source.controls).all()
    assert source.notes == (f"{tmp_path / 't'}: 2 deleted records are left out",)


@pytest.mark.parametrize(
    ("records", "about", "message"),
    [
        (["{"], '{"paths": ["catalog_7.catalog"]}', "catalog_7.catalog: line 1 is damaged"),
        ([record(0)], "{}", "manifest.json: is damaged"),
        ([record(0)], '{"paths": ["nowhere.catalog"]}', "nowhere.catalog: cannot be read"),
        (['{"_index": 1}'], '{"paths": ["catalog_7.catalog"]}', "has no records with images"),
        (["[" * 100_000], '{"paths": ["catalog_7.catalog"]}', "line 1 is damaged"),
    ],
)
def test_a_damaged_tub_is_one_line(records, about, message, tmp_path):
    assert message in refusal(tub(tmp_path / "t", records, about))


def test_a_tub_reads_no_image_outside_of_its_folder(tmp_path):
    (tmp_path / "secret.jpg").write_bytes(encoded(".jpg"))
    entry = record(0).replace("0.jpg", "../../secret.jpg")
    about = '{"paths": ["catalog_7.catalog"]}'
    assert "secret.jpg cannot be read" in refusal(tub(tmp_path / "t", [entry], about))


def test_the_given_video_with_a_colon_in_its_name_is_read(cases, monkeypatch):
    monkeypatch.chdir(cases / "video_name_with_colon")
    assert len(list(open_source("2024-01-01T10:20:30.mp4"))) == 30


@pytest.mark.parametrize("name", ["http:a.avi", "concat:x|y.avi", "file:b.avi", "%03d.avi"])
def test_a_name_that_looks_like_a_protocol_is_a_file(name, tmp_path, monkeypatch):
    motion_jpeg(tmp_path / "v.avi", 3)
    (tmp_path / "v.avi").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(list(open_source(name))) == 3


def test_the_given_drive_of_50_frames_is_read_whole(cases):
    frames = list(open_source(cases / "kidnap_false_alarm" / "frames.tar.gz"))
    assert [f.index for f in frames] == list(range(50))
    assert len({f.image.shape for f in frames}) == 1


@pytest.mark.parametrize("options", [(), ("--preset", "rc_car"), ("--preset", "ratslam")])
def test_a_bump_of_the_given_drive_is_no_kidnapping(options, cases, tmp_path, call):
    source = cases / "kidnap_false_alarm" / "frames.tar.gz"
    done = call("run", source, "-o", tmp_path / "o", "--no-tensorboard", *options)
    assert (done.code, done.err) == (0, "")
    figures = json.loads((tmp_path / "o" / "metrics.json").read_text())
    assert figures["frames"] == 50
    assert (figures["not_joined"], figures["merges"]) == ([], 0)
    assert figures["frames_on_no_joined_map"] == 0


# --- links and separators ------------------------------------------------------------------------


def test_links_of_an_archive_are_left_out_and_counted(tmp_path):
    with tarfile.open(tmp_path / "a.tar", "w") as tar:
        for k, kind in enumerate((tarfile.REGTYPE, tarfile.SYMTYPE, tarfile.LNKTYPE)):
            data = encoded(".png", picture(k)) if kind == tarfile.REGTYPE else b""
            info = tarfile.TarInfo(f"{k}.png")
            info.type, info.size, info.linkname = kind, len(data), "/etc/passwd"
            tar.addfile(info, io.BytesIO(data))
    source = open_source(tmp_path / "a.tar")
    assert source.n_frames == 1
    assert "2 images are left out: a link or no regular file" in "".join(source.notes)


def test_pipes_and_broken_links_of_a_folder_are_left_out_and_counted(tmp_path):
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "0.png").write_bytes(encoded(".png", picture(0)))
    os.mkfifo(tmp_path / "f" / "1.png")
    (tmp_path / "f" / "2.png").symlink_to("nowhere")
    source = open_source(tmp_path / "f")
    assert source.n_frames == 1
    assert "2 images are left out" in "".join(source.notes)


@pytest.mark.parametrize(("mark", "name"), [(";", "semicolons"), ("\t", "tabs"), (" ", "spaces")])
def test_a_table_with_other_separators_is_refused_by_their_name(mark, name, tmp_path):
    rows = ["time_s,v_m_s,w_rad_s", "0.0,1.0,0.0", "0.1,1.0,0.0"]
    (tmp_path / "m.csv").write_text("\n".join(rows).replace(",", mark))
    assert f"its columns are separated by {name}: write commas" in refusal(tmp_path / "m.csv")
