"""A trajectory gives the same cells in whatever form a laboratory stores it."""

import numpy as np
import pytest

from neuroslam import ActivityLog, open_source, record
from neuroslam.errors import ConfigError, SourceError
from neuroslam.worlds.animal_tracks import hull_of, read_animal_track
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import ArenaSource

SQUARE = named_arena("square")


@pytest.fixture(scope="module")
def walk():
    return roam(SQUARE, 0.5, np.random.default_rng(3), speed_m_s=0.2)


@pytest.fixture
def csv_file(walk, tmp_path):
    rows = zip(
        (1e3 * walk.times_s).tolist(), *(100 * walk.positions.T).tolist(),
        np.degrees(walk.headings_rad).tolist(), strict=True,
    )  # fmt: skip
    path = tmp_path / "rat.csv"
    path.write_text(
        "moment,px,py,head\n" + "".join(f"{t!r},{x!r},{y!r},{h!r}\n" for t, x, y, h in rows)
    )
    return path


COLUMNS = {"t": "moment", "hd": "head"}


class Environment:
    boundary_conditions = "solid"
    boundary = SQUARE.boundary.tolist()
    holes = ()
    walls = np.empty((0, 2, 2))
    extent = (-10.0, 10.0, -10.0, 10.0)


class Agent:
    """An agent with the attributes of one of RatInABox."""

    name = "agent"
    Environment = Environment()

    def __init__(self, walk):
        directions = np.column_stack([np.cos(walk.headings_rad), np.sin(walk.headings_rad)])
        self.history = {
            "t": walk.times_s.tolist(), "pos": walk.positions.tolist(),
            "head_direction": directions.tolist(),
        }  # fmt: skip


def test_the_same_track_gives_the_same_rates_in_every_form(walk, csv_file, tmp_path):
    arrays = {"pos": walk.positions, "t": walk.times_s, "hd": walk.headings_rad}
    np.savez(tmp_path / "rat.npz", **arrays, **SQUARE.to_arrays())
    forms = {
        "csv": read_animal_track(csv_file, columns=COLUMNS, units="cm,deg,ms", arena=SQUARE),
        "npz": read_animal_track(tmp_path / "rat.npz"),
        "agent": read_animal_track(Agent(walk)),
    }
    try:
        nothing = {"none": np.zeros((len(walk.times_s), 1))}
        log = ActivityLog.from_arrays(walk.times_s, walk.positions, nothing, walk.headings_rad)
        forms["nwb"] = read_animal_track(log.to_nwb(tmp_path / "rat.nwb"), arena=SQUARE)
    except ConfigError:  # without pynwb
        pass
    expected = record(ArenaSource(walk))
    for form, read in forms.items():
        assert read.arena is not None, form
        log = record(ArenaSource(read))
        for name in expected.names:
            np.testing.assert_allclose(
                log[name], expected[name], rtol=0, atol=1e-6, err_msg=f"{form} {name}"
            )


def test_the_command_line_reads_by_the_same_rule(walk, csv_file):
    source = open_source(f"track:{csv_file}?t=moment&hd=head&units=cm,deg,ms")
    read = read_animal_track(csv_file, columns=COLUMNS, units="cm,deg,ms")
    np.testing.assert_array_equal(source.walk.positions, read.positions)
    np.testing.assert_allclose(read.positions, walk.positions, atol=1e-12)
    np.testing.assert_allclose(read.headings_rad, walk.headings_rad, atol=1e-9)
    assert read.arena.contains(read.positions).all()
    assert any("outline of the track is taken" in note for note in source.notes)
    assert (
        open_source(f"track:{csv_file}?t=moment&hd=head&units=cm,deg,ms&arena=none").walk.arena
        is None
    )


def test_lost_tracking_and_impossible_speeds_are_reported(tmp_path):
    path = tmp_path / "rat.csv"
    rows = [f"{k / 10},{k / 50},{0.0 if k % 2 else 0.05}\n" for k in range(60)]
    rows[20:30] = [f"{k / 10},,\n" for k in range(20, 30)]
    rows[40] = "4.0,9.0,0.0\n"
    path.write_text("Time,X,Y\n" + "".join(rows))
    walk = read_animal_track(path)
    assert len(walk.times_s) == 50
    assert any("10 samples of 60" in note and "1.10 s" in note for note in walk.notes)
    assert any("2 steps faster than 2 m/s" in note and "4.000 s" in note for note in walk.notes)
    smooth = read_animal_track(path, smooth_s=0.3, arena=None)
    assert (
        np.abs(np.diff(smooth.positions[:, 0])).max()
        < 0.5 * np.abs(np.diff(walk.positions[:, 0])).max()
    )


def test_a_periodic_environment_has_no_walls_and_no_jumps(walk):
    agent = Agent(walk)
    agent.Environment = Environment()
    agent.Environment.boundary_conditions = "periodic"
    agent.Environment.extent = (0.0, 0.5, 0.0, 0.5)
    agent.history["pos"] = (walk.positions % 0.5).tolist()
    read = read_animal_track(agent)
    assert read.arena is None
    moved = walk.positions - walk.positions[0]
    np.testing.assert_allclose(read.positions - read.positions[0], moved, atol=1e-9)


def test_what_cannot_be_read_is_said_in_one_line(tmp_path, csv_file):
    with pytest.raises(SourceError, match=r"no column for t among moment, px, py, head.*t=NAME"):
        read_animal_track(csv_file)
    with pytest.raises(ConfigError, match="unknown 'inch'"):
        read_animal_track(csv_file, columns=COLUMNS, units="inch")
    with pytest.raises(ConfigError, match="has no column 'foo'"):
        read_animal_track(csv_file, columns={"t": "foo"})
    with pytest.raises(SourceError, match="outside the arena"):
        read_animal_track(csv_file, columns=COLUMNS, units="m", arena=SQUARE)  # cm taken for m
    with pytest.raises(SourceError, match="unknown option 'unit'"):
        open_source(f"track:{csv_file}?unit=cm")
    line = np.column_stack([np.arange(5.0), np.zeros(5)])
    with pytest.raises(SourceError, match="lie on a line"):
        hull_of(line)


# --- what laboratories' files have: units, gaps, wrong clocks, hostile content --------------------

N = 40
PATH = np.column_stack([0.3 * np.cos(0.1 * np.arange(N)), 0.3 * np.sin(0.1 * np.arange(N))])


def table(path, header="time,x,y", scale=1.0, tick=0.05, more=(), change=None):
    columns = [[f"{tick * k:.10g}" for k in range(N)], *(scale * PATH).T.tolist(), *more]
    rows = [list(map(str, row)) for row in zip(*columns, strict=True)]
    if change is not None:
        change(rows)
    path.write_text("\n".join([header, *map(",".join, rows)]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "scale", "tick"),
    [
        ("Timestamp [ms],x_cm,y_cm", 100.0, 50.0),
        ("clock,x [cm],y [cm]", 100.0, 0.05),
        ("time_us,x_mm,y_mm", 1000.0, 50_000.0),
        ("time (ns),x (m),y (m)", 1.0, 5e7),
        ("t,x_m,y_m", 1.0, 50.0),
        ("# t,pos_x,pos_y", 1.0, 0.05),
        ("# of a rat\n# a second line\ntime_ms,X,Y", 1.0, 50.0),
    ],
)
def test_units_are_those_of_the_columns(header, scale, tick, tmp_path):
    walk = read_animal_track(table(tmp_path / "r.csv", header, scale, tick))
    np.testing.assert_allclose(walk.positions, PATH, atol=1e-12)
    np.testing.assert_allclose(walk.times_s, 0.05 * np.arange(N), atol=1e-9)
    said = any("times are in" in note for note in walk.notes)
    assert said == (tick != 0.05)


def test_columns_may_differ_in_their_units(tmp_path):
    walk = read_animal_track(table(tmp_path / "r.csv", "time,x_cm,y_m", 1.0), arena=None)
    np.testing.assert_allclose(walk.positions, PATH * [0.01, 1.0], atol=1e-12)


def test_times_in_milliseconds_at_200_hz_are_no_seconds(tmp_path):
    for header in ("time_ms,x,y", "t,x,y"):
        walk = read_animal_track(table(tmp_path / "r.csv", header, tick=5.0), units="m", arena=None)
        assert walk.times_s[-1] == pytest.approx(0.195)
    np.savez(tmp_path / "r.npz", pos=PATH, t=5.0 * np.arange(N))
    assert any(
        "are the times in milliseconds?" in n for n in read_animal_track(tmp_path / "r.npz").notes
    )


def test_dates_are_times(tmp_path):
    def dates(rows):
        for k, row in enumerate(rows):
            row[0] = f"2024-05-01T12:00:{0.05 * k:06.3f}"

    walk = read_animal_track(table(tmp_path / "r.csv", change=dates))
    np.testing.assert_allclose(walk.times_s - walk.times_s[0], 0.05 * np.arange(N), atol=1e-6)


def test_head_directions_in_degrees_are_noticed(tmp_path):
    degrees = (9.0 * np.arange(N)) % 360.0
    expected = (np.radians(degrees) + np.pi) % (2 * np.pi) - np.pi
    for header, said in (("time,x,y,hd", True), ("time,x,y,hd_deg", False)):
        walk = read_animal_track(table(tmp_path / "r.csv", header, more=[degrees.tolist()]))
        np.testing.assert_allclose(walk.headings_rad, expected, atol=1e-9)
        assert said == any("are in degrees, as their size shows" in n for n in walk.notes)
    np.savez(tmp_path / "r.npz", pos=PATH, t=0.05 * np.arange(N), hd=degrees)
    walk = read_animal_track(tmp_path / "r.npz")
    np.testing.assert_allclose(walk.headings_rad, expected, atol=1e-9)
    with pytest.raises(SourceError, match="say which: units=deg or units=rad"):
        read_animal_track(
            table(tmp_path / "r.csv", "time,x,y,hd", more=[(40.0 * np.arange(N)).tolist()])
        )


@pytest.mark.parametrize("wrong", ["99.0", "-3.0", "", "nan", "1e300"])
@pytest.mark.parametrize("column", [0, 1])
def test_a_wrong_number_costs_its_own_row(wrong, column, tmp_path):
    def spoil(rows):
        rows[7][column] = wrong

    walk = read_animal_track(table(tmp_path / "r.csv", change=spoil), arena=None)
    if column == 1 and wrong in ("99.0", "-3.0"):
        assert any("2 steps faster than 2 m/s" in note for note in walk.notes)
        return
    np.testing.assert_allclose(walk.positions, np.delete(PATH, 7, axis=0), atol=1e-12)
    assert any("1 sample of 40" in note for note in walk.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time;x;y\n0;1;2\n1;1;1\n2;1;0\n", "separated by semicolons"),
        ("time,x,y\n0,0,1,5,2,5\n0,1,1,5,2,6\n0,2,1,5,2,7\n", "line 2 has 6 values; expected 3"),
        ("time,x,y\n0," + "9" * 200_000 + ",2\n", "field larger than field limit"),
        ("time,x [px],y [px]\n0,1,2\n1,1,1\n", "is in pixels; convert it"),
        ("time,x,x,y\n0,1,2,3\n1,2,3,4\n", "has 2 columns 'x'"),
        ("frame,x,y\n0,1,2\n1,1,1\n", "no column for t among frame, x, y"),
        ("time,x,y,hd\n0,1,2,\n1,1,1,\n2,0,0,\n", "head direction has no number"),
        ("", "has no rows"),
    ],
)
def test_a_table_that_would_be_read_wrongly_is_one_line(text, message, tmp_path):
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(SourceError, match=message) as caught:
        read_animal_track(
            tmp_path / "r.csv", columns={"x": "x [px]", "y": "y [px]"} if "px" in text else None
        )
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"hd": np.zeros(3)}, r"hd has shape \(3,\)"),
        ({"hd": np.zeros((N, 2))}, r"hd has shape \(40, 2\)"),
        ({"hd": np.array(["a"] * N)}, "hd has shape"),
        ({"vertices": np.array(["a"])}, "is not of numbers"),
        ({"vertices": np.ones((20_000, 2))}, "20,000 vertices; expected at most"),
    ],
)
def test_wrong_arrays_beside_a_track_are_one_line(arrays, message, tmp_path):
    np.savez(tmp_path / "r.npz", pos=PATH, t=0.05 * np.arange(N), **arrays)
    with pytest.raises(SourceError, match=message):
        read_animal_track(tmp_path / "r.npz")


def test_options_that_would_take_all_memory_or_contradict_are_one_line(tmp_path):
    path = table(tmp_path / "r.csv")
    with pytest.raises(SourceError, match=r"smoothing is 1e\+09 s, and the track lasts 1.95 s"):
        read_animal_track(path, smooth_s=1e9)
    with pytest.raises(ConfigError, match="two units of length"):
        read_animal_track(path, units="cm,m")


@pytest.mark.parametrize("name", ["a b?c&d=e.csv", "a:b.csv", "r+s.csv", "день.csv"])
def test_a_track_of_any_name_is_read(name, tmp_path):
    path = table(tmp_path / name)
    assert len(open_source(f"track:{path}").walk.times_s) == N
    assert len(open_source(f"track:{path}?arena=none").walk.times_s) == N


# --- NWB ------------------------------------------------------------------------------------------


@pytest.fixture
def nwb(tmp_path):
    pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed: extra neuro")
    import warnings
    from datetime import UTC, datetime

    from pynwb.behavior import CompassDirection, Position, SpatialSeries

    def make(positions=PATH, unit="meters", hd=None, tick=0.05):
        with warnings.catch_warnings(action="ignore"):
            file = pynwb.NWBFile("a rat", "r", datetime(2024, 1, 1, tzinfo=UTC))
            times = tick * np.arange(N)
            kept = {"reference_frame": "corner", "timestamps": times}
            series = SpatialSeries(name="p", data=positions, unit=unit, **kept)
            module = file.create_processing_module("behavior", "of a rat")
            module.add(Position(spatial_series=series))
            if hd is not None:
                turns = SpatialSeries(name="h", data=hd, unit="radians", **kept)
                module.add(CompassDirection(spatial_series=turns))
            with pynwb.NWBHDF5IO(str(tmp_path / "r.nwb"), "w") as io:
                io.write(file)
        return tmp_path / "r.nwb"

    return make


def replaced(path, name, make):
    """Replace a data set of an HDF5 file, and keep its attributes."""
    import h5py

    with h5py.File(path, "r+") as file:
        found = []
        file.visititems(lambda key, _: found.append(key) if key.endswith(name) else None)
        about = dict(file[found[0]].attrs)
        del file[found[0]]
        made = make(file, found[0])
        if made is not None:
            made.attrs.update(about)
    return path


def test_units_of_an_nwb_file_are_kept_or_said(nwb):
    np.testing.assert_allclose(read_animal_track(nwb(100 * PATH, "cm")).positions, PATH)
    assert any(
        "is no length; metres assumed" in n for n in read_animal_track(nwb(unit="a.u.")).notes
    )
    with pytest.raises(SourceError, match="are in pixels"):
        read_animal_track(nwb(unit="pixels"))
    walk = read_animal_track(nwb(tick=50.0))
    assert walk.times_s[-1] == pytest.approx(1.95)
    assert any("milliseconds, as their size shows" in note for note in walk.notes)


def test_a_lost_head_direction_of_an_nwb_file_is_interpolated(nwb):
    hd = 0.01 * np.arange(N)
    walk = read_animal_track(nwb(hd=np.where(np.arange(N) == 3, np.nan, hd)))
    np.testing.assert_allclose(walk.headings_rad, hd, atol=1e-9)


def test_an_nwb_file_that_names_other_data_or_fills_memory_is_one_line(nwb, tmp_path, monkeypatch):
    import h5py

    monkeypatch.setenv("NEUROSLAM_MAX_MEMORY", "100M")
    whole = {"shape": (10**9, 2), "chunks": (1000, 2), "dtype": "f8"}
    path = replaced(nwb(), "p/data", lambda file, key: file.create_dataset(key, **whole))
    with pytest.raises(SourceError, match="see --max-memory"):
        read_animal_track(path)

    def link(file, key):
        file[key] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/x")

    with pytest.raises(SourceError, match="is a link to another file"):
        read_animal_track(replaced(nwb(), "p/data", link))
    path = replaced(nwb(), "p/timestamps", lambda file, key: file.create_dataset(key, data=[0.0]))
    with pytest.raises(SourceError, match="1 times for 40 samples"):
        read_animal_track(path)
    path.write_bytes(nwb().read_bytes()[:3000])
    with pytest.raises(SourceError, match="is no readable NWB file"):
        read_animal_track(path)


def test_positions_without_a_unit_that_would_be_too_fast_in_metres_are_refused(tmp_path):
    path = tmp_path / "rat.csv"
    path.write_text("time,x,y\n" + "".join(f"{k / 20},{k},{k % 3}\n" for k in range(50)))
    with pytest.raises(SourceError, match=r"median speed is .* m/s; expected at most 2 m/s"):
        read_animal_track(path, arena=None)
    assert read_animal_track(path, units="cm", arena=None).positions[10].tolist() == [0.1, 0.01]
    assert read_animal_track(path, units="m", arena=None).positions[10].tolist() == [10.0, 1.0]
