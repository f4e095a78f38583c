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
        "clock,px,py,head\n" + "".join(f"{t!r},{x!r},{y!r},{h!r}\n" for t, x, y, h in rows)
    )
    return path


COLUMNS = {"t": "clock", "hd": "head"}


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
    source = open_source(f"track:{csv_file}?t=clock&hd=head&units=cm,deg,ms")
    read = read_animal_track(csv_file, columns=COLUMNS, units="cm,deg,ms")
    np.testing.assert_array_equal(source.walk.positions, read.positions)
    np.testing.assert_allclose(read.positions, walk.positions, atol=1e-12)
    np.testing.assert_allclose(read.headings_rad, walk.headings_rad, atol=1e-9)
    assert read.arena.contains(read.positions).all()
    assert any("outline of the track is taken" in note for note in source.notes)
    assert (
        open_source(f"track:{csv_file}?t=clock&hd=head&units=cm,deg,ms&arena=none").walk.arena
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
    with pytest.raises(SourceError, match=r"no column for t among clock, px, py, head.*t=NAME"):
        read_animal_track(csv_file)
    with pytest.raises(ConfigError, match="unknown 'inch'"):
        read_animal_track(csv_file, columns=COLUMNS, units="inch")
    with pytest.raises(ConfigError, match="has no column 'foo'"):
        read_animal_track(csv_file, columns={"t": "foo"})
    with pytest.raises(SourceError, match="outside the arena"):
        read_animal_track(csv_file, columns=COLUMNS, arena=SQUARE)  # cm taken for m
    with pytest.raises(SourceError, match="unknown option 'unit'"):
        open_source(f"track:{csv_file}?unit=cm")
    line = np.column_stack([np.arange(5.0), np.zeros(5)])
    with pytest.raises(SourceError, match="lie on a line"):
        hull_of(line)
