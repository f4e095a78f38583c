"""A population that is defined here takes part in everything that a brain does."""

import base64
import copy
import csv
import math
import os
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
import torch
from pydantic import Field
from torch import Tensor, nn

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.config import Section, populations
from neuroslam.report import write_report
from neuroslam.report.collect import collect
from neuroslam.report.reading import read_run
from neuroslam.runs.export import export
from neuroslam.runs.inspect import inspect
from neuroslam.runs.merge import merge_runs
from neuroslam.runs.plot import plot
from neuroslam.runs.run import resume, run
from neuroslam.runs.sweep import sweep
from neuroslam.runs.verify import verify
from neuroslam.sensors import open_source
from neuroslam.state.match import Match, Pairs
from neuroslam.state.mergeable import about_now, rows_of_experiences, summed_by_view
from neuroslam.state.population import Belief, Decision, Population
from neuroslam.state.registry import register
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, Pose, PoseEstimate

WORLD = "world:ellipse?width=128&height=32"
GAIN = 3


class TallyConfig(Section):
    gain: int = Field(1, ge=1, description="added for each frame that shows a view")


def placed_rows_of_views(loaded, partial, join):
    """Poses of partial views, moved into the loaded map, after those of the loaded ones."""
    moved = torch.from_numpy(join.place(partial.numpy()))
    return torch.cat([loaded, moved[torch.from_numpy(join.kept_views)]])


class Tally(Population):
    """How often each view is shown, and where it was first."""

    config_section = TallyConfig
    needs_views = True
    growing = ("seen",)
    merge_rules: ClassVar = {
        "seen": summed_by_view,
        "first": placed_rows_of_views,
        "now": about_now,
        "weights": about_now,
    }

    def __init__(self, config=None):
        super().__init__()
        self.config = config or TallyConfig()
        self.register_buffer("seen", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("weights", torch.arange(4.0))
        self.first = GrowingTable({"pose": ((3,), torch.float64)})
        self.now = Scalars(since_s=0.0, view=NO_TEMPLATE)

    def learn(self, now, observation):
        view = now.view.template
        self.now.since_s = self.now.since_s + now.motion.dt_s if view == self.now.view else 0.0
        self.now.view = view
        if view != NO_TEMPLATE:
            seen = nn.functional.pad(self.seen, (0, max(0, view + 1 - len(self.seen))))
            self.seen = seen + self.config.gain * (torch.arange(len(seen)) == view)

    def recall(self, now, observation, belief):
        if now.view.is_new:
            self.first.append(pose=torch.tensor(belief.pose))

    @property
    def rates(self):
        return self.seen.numpy().astype(float)

    def counts(self):
        return {"tally_seen": self.seen.sum(), "tally_since_s": np.float64(self.now.since_s)}

    def scalars(self):
        return {"tally/seen": self.seen.sum()}

    def images(self):
        return {"tally/seen": self.seen[None, :]}

    def tables(self):
        return {
            "tally.csv": "\n".join(["view,seen", *map(self._row, range(len(self.seen)))]) + "\n"
        }

    def _row(self, view):
        return f"{view},{self.seen[view]}"

    def points_m(self):
        return self.first["pose"][:, :2].numpy(force=True)

    @classmethod
    def faults(cls, state, config, n_views, n_experiences):
        if (state["seen"] < 0).any():
            yield "tally.seen: negative"
        if len(state["first.pose"]) != n_views:
            yield f"tally.first: {len(state['first.pose'])} poses of {n_views} views"


@pytest.fixture(scope="module", autouse=True)
def tally():
    register("tally")(Tally)
    yield Tally
    del populations.registered["tally"]


@pytest.fixture(scope="module")
def config(tally):
    return BrainConfig(cells="pose+tally", tally={"gain": GAIN})


@pytest.fixture(scope="module")
def frames():
    return list(open_source(WORLD).frames(0, 250))


@pytest.fixture(scope="module")
def runs(config, tmp_path_factory):
    """Two overlapping drives, their merge, and the first drive without the population."""
    folder = tmp_path_factory.mktemp("runs")
    run(WORLD, folder / "monday", config, stop=200)
    run(WORLD, folder / "tuesday", config, start=100, stop=250, tensorboard=False)
    run(WORLD, folder / "without", BrainConfig(), stop=200, tensorboard=False)
    merged, _ = merge_runs(folder / "monday", folder / "tuesday", folder / "both")
    assert merged is not None
    return folder


def driven(config, frames, stored=()):
    brain = NavigationBrain(config)
    for one in stored:
        brain.store(one)
    for frame in frames:
        brain(frame)
    return brain


def equal(one, other):
    a, b = (brain.state_dict() for brain in (one, other))
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# --- in Python -----------------------------------------------------------------------------------


def test_it_is_an_attribute_of_the_brain_with_its_section_of_the_config(config, frames):
    brain = driven(config, frames[:30])
    assert brain.populations["tally"] is brain.tally
    assert brain.tally.config == config.tally == TallyConfig(gain=GAIN)
    assert brain.tally.seen.sum() == 30 * GAIN
    assert len(brain.tally.seen) == brain.tally.first.n == brain.view.n
    np.testing.assert_array_equal(brain.landmarks_m, brain.tally.points_m())


@pytest.mark.parametrize("how", ["save_brain", "state_dict", "deepcopy", "to"])
def test_a_copy_goes_on_bit_for_bit(how, config, frames, tmp_path):
    brain = driven(config, frames[:60])
    if how == "save_brain":
        save_brain(brain, tmp_path / "brain.safetensors")
        other = load_brain(tmp_path / "brain.safetensors")
    elif how == "state_dict":
        other = NavigationBrain(config)
        other.load_state_dict(brain.state_dict())
    elif how == "deepcopy":
        other = copy.deepcopy(brain)
    else:
        other = copy.deepcopy(brain).to("cpu", non_blocking=True)
    assert other.populations["tally"] is other.tally is not brain.tally
    for frame in frames[60:100]:
        assert brain(frame) == other(frame)
    assert equal(brain, other)
    assert brain.tally.seen.sum() == 100 * GAIN


def test_a_second_session_recognises_the_first_map_and_what_both_learnt_adds_up(config, frames):
    first = driven(config, frames[:200])
    brain = driven(config, frames[100:250], [first])
    (report,) = brain.sessions.merges
    assert len(brain.stored) == 0
    assert report["counts"]["tally_seen"]["loaded"] == 200 * GAIN
    assert brain.tally.seen.sum() == (200 + 150) * GAIN
    assert len(brain.tally.seen) == brain.view.n
    assert brain.tally.now.view == brain.view.last.template


def test_after_a_gap_it_begins_anew_and_the_old_one_is_stored(config, frames):
    config = config.model_copy(
        update={"sessions": config.sessions.model_copy(update={"after_gap": "new_map"})}
    )
    brain = driven(config, frames[:50])
    brain(frames[150]._replace(time_s=frames[49].time_s + 60.0))
    assert brain.stored[0].tally.seen.sum() == 50 * GAIN
    assert brain.populations["tally"] is brain.tally
    assert brain.tally.seen.sum() == GAIN


# --- folders of runs -----------------------------------------------------------------------------


def test_a_run_that_was_cut_and_resumed_is_the_uncut_one(config, runs, tmp_path):
    run(WORLD, tmp_path / "cut", config, stop=90, tensorboard=False)
    resume(tmp_path / "cut", stop=200, tensorboard=False)
    whole, cut = (
        load_brain(out / "brain.safetensors") for out in (runs / "monday", tmp_path / "cut")
    )
    assert equal(whole, cut)
    for name in ("tally.csv", "frames.csv", "experiences.csv"):
        assert (tmp_path / "cut" / name).read_bytes() == (runs / "monday" / name).read_bytes()


def test_its_table_and_counts_are_files_of_the_run(runs):
    seen = load_brain(runs / "monday" / "brain.safetensors").tally.seen
    table = rows(runs / "monday" / "tally.csv")
    assert [int(row["seen"]) for row in table] == seen.tolist()
    assert ("tally seen", "600") in inspect(runs / "monday")


def test_one_that_only_watches_changes_nothing_of_the_map(runs, tmp_path):
    for name in ("frames.csv", "experiences.csv", "links.csv", "trajectory.tum"):
        assert (runs / "monday" / name).read_bytes() == (runs / "without" / name).read_bytes()
    for kind in ("tum", "g2o"):
        both = [tmp_path / f"{name}.{kind}" for name in ("monday", "without")]
        for path in both:
            export(runs / path.stem, path)
        assert both[0].read_bytes() == both[1].read_bytes()


def test_two_finished_runs_merge_and_what_both_learnt_adds_up(runs):
    monday, tuesday, both = (
        load_brain(runs / name / "brain.safetensors") for name in ("monday", "tuesday", "both")
    )
    (report,) = both.sessions.merges
    assert report["counts"]["tally_seen"] == {
        "loaded": 200 * GAIN, "partial": 150 * GAIN, "merged": 350 * GAIN
    }  # fmt: skip
    assert both.tally.seen.sum() == monday.tally.seen.sum() + tuesday.tally.seen.sum()
    assert ("tally seen", f"{350 * GAIN}") in inspect(runs / "both")
    assert both.tally.now.since_s == tuesday.tally.now.since_s


def test_where_it_has_learnt_views_lies_on_the_merged_map(runs):
    both = load_brain(runs / "both" / "brain.safetensors")
    template = both.map.experiences["template"].numpy()
    made = [int(np.flatnonzero(template == view)[0]) for view in range(both.view.n)]
    apart = np.hypot(*(both.tally.points_m() - both.map.poses[made, :2]).T)
    assert apart.max() < 0.1
    assert np.ptp(both.tally.points_m(), axis=0).max() > 5.0


def test_a_sound_run_and_a_sound_merge_are_told_so(runs):
    assert verify(runs / "monday") == []
    assert verify(runs / "both") == []
    assert verify(runs / "both" / "brain.safetensors") == []


@pytest.mark.parametrize(
    ("name", "wrong", "told"),
    [
        ("seen", lambda seen: -seen, "tally.seen: negative"),
        ("first.pose", lambda pose: pose[:-1], "tally.first: "),
        ("first.pose", lambda pose: pose * math.nan, "tally.first.pose: not finite"),
        ("weights", lambda weights: weights[:2], "size mismatch for tally.weights"),
        ("seen", lambda seen: seen.double(), "tally.seen: torch.float64; expected torch.int64"),
        ("now.view", lambda _: None, "tally.now.view: missing"),
    ],
)
def test_what_is_wrong_with_its_state_is_found(name, wrong, told, runs, tmp_path):
    brain = load_brain(runs / "monday" / "brain.safetensors")
    state = brain.state_dict()
    value = wrong(state.pop(f"tally.{name}"))
    state |= {} if value is None else {f"tally.{name}": value}
    brain.state_dict = lambda: state
    save_brain(brain, tmp_path / "brain.safetensors")
    faults = verify(tmp_path / "brain.safetensors")
    assert len(faults) == 1, faults
    assert told in faults[0]


def test_a_table_that_is_not_its_own_is_found(config, tmp_path):
    run(WORLD, tmp_path / "run", config, stop=20, tensorboard=False)
    table = tmp_path / "run" / "tally.csv"
    table.write_text(table.read_text().replace("\n0,", "\n0,1"))
    (fault,) = verify(tmp_path / "run")
    assert fault == f"{table}: rows 0 differ from the brain"
    table.unlink()
    (fault,) = verify(tmp_path / "run")
    assert fault.startswith(f"{table}: cannot be read")


def test_its_curve_and_pictures_are_in_tensorboard(runs):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(runs / "monday" / "events"))
    events.Reload()
    points = events.Scalars("tally/seen")
    assert [point.step for point in points] == list(range(0, 200, 10))
    assert [point.value for point in points] == [GAIN * (k + 1) for k in range(0, 200, 10)]
    (first, *_) = events.Images("tally/seen")
    assert (first.width, first.height) == (200, 200)  # of the one view that there was


def test_its_picture_is_drawn(runs, tmp_path):
    written = plot(runs / "monday", tmp_path)
    assert tmp_path / "tally_seen.png" in written
    assert cv2.imread(str(tmp_path / "tally_seen.png")).std() > 0


def test_the_report_shows_its_counts_and_its_picture(runs, tmp_path):
    facts = collect(read_run(runs / "both"))
    (card,) = [one for one in facts.about["populations"] if one["kind"] == "tally"]
    assert card["what"] == "How often each view is shown, and where it was first."
    assert ["tally seen", 350 * GAIN, ""] in card["counts"]
    (picture,) = card["pictures"]
    (layer,) = picture["layers"]
    seen = load_brain(runs / "both" / "brain.safetensors").tally.seen.numpy()
    assert (picture["tag"], layer["width"], layer["height"]) == ("tally/seen", len(seen), 1)
    png = cv2.imdecode(np.frombuffer(base64.b64decode(layer["png"]), np.uint8), cv2.IMREAD_COLOR)
    grey = np.round(255.0 * seen / seen.max()).astype(np.uint8)[None]
    np.testing.assert_array_equal(png, cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS))
    page = write_report(runs / "both", tmp_path / "report.html").read_text()
    assert layer["png"] in page
    config = {section["section"]: section for section in facts.about["config"]}
    assert config["tally"]["used"]
    assert config["tally"]["rows"][0]["value"] == str(GAIN)


def test_the_report_knows_the_packages_own_cells_of_one_file_too(tmp_path):
    config = BrainConfig(cells="pose+head_direction+speed")
    run(WORLD, tmp_path / "run", config, stop=20, tensorboard=False)
    cards = collect(read_run(tmp_path / "run")).about["populations"]
    assert [card["kind"] for card in cards] == ["head direction", "speed"]
    assert [p["tag"] for c in cards for p in c["pictures"]] == [
        "cells/head_direction",
        "cells/speed",
    ]
    assert all("`" not in card["what"] for card in cards)


# --- a file of its own, and other processes ------------------------------------------------------

PLUGIN = textwrap.dedent(
    """
    import torch
    from neuroslam.config import Section
    from neuroslam.state.mergeable import summed
    from neuroslam.state.population import Population
    from neuroslam.state.registry import register

    class DrawsConfig(Section):
        seed: int = 0
        step: int = 1

    @register("draws")
    class Draws(Population):
        config_section = DrawsConfig
        merge_rules = {"total": summed}

        def __init__(self, config=None):
            super().__init__()
            self.config = config or DrawsConfig()
            self.register_buffer("total", torch.tensor(0))

        def learn(self, now, observation):
            self.total = self.total + self.config.step

        def counts(self):
            return {"draws": self.total + 1000 * self.config.seed}
    """
)


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """A file that registers a population; afterwards nothing knows of it."""
    monkeypatch.setenv(populations.PLUGINS, "")
    monkeypatch.setattr(populations, "_loaded", dict(populations._loaded))
    before, modules = dict(populations.registered), set(sys.modules)
    path = tmp_path / "draws.py"
    path.write_text(PLUGIN)
    yield path
    for kind in populations.registered.keys() - before.keys() - populations.HOMES.keys():
        del populations.registered[kind]
    for name in set(sys.modules) - modules:
        if name.startswith("neuroslam_plugin_"):
            del sys.modules[name]


def test_processes_of_a_sweep_load_the_file_and_its_seed_is_varied_too(plugin, tmp_path):
    populations.load_plugin(plugin)
    table = sweep(
        [WORLD], tmp_path / "out", vary=["draws.step=1,2"], seeds=2, stop=15, jobs=2,
        assignments=["cells=pose+draws"],
    )  # fmt: skip
    assert [row["error"] for row in table] == [""] * 4
    assert [row["draws"] for row in table] == [15, 1015, 30, 1030]
    assert [row["draws"] for row in rows(tmp_path / "out" / "sweep.csv")] == [
        "15", "1015", "30", "1030"
    ]  # fmt: skip


WORKER = """
import sys
from neuroslam.runs.parallel import _attempt_on_ray
print(_attempt_on_ray({"NEUROSLAM_PLUGINS": sys.argv[1]}, bytes.fromhex(sys.argv[2])))
"""


def test_a_worker_of_ray_loads_the_file_before_it_reads_a_config(plugin, tmp_path):
    """It is started by the cluster: it has nothing of this process's environment."""
    populations.load_plugin(plugin)
    call = pickle.dumps((str, BrainConfig(cells="pose+draws", draws={"step": 7}).section("draws")))
    here = {k: v for k, v in os.environ.items() if k != populations.PLUGINS}
    said = {}
    for file in (plugin, tmp_path / "nowhere.py"):
        done = subprocess.run(
            [sys.executable, "-c", WORKER, str(file), call.hex()],
            capture_output=True, text=True, check=False,
            env=here | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        said[file.name] = done.stdout.strip()
    assert said["draws.py"] == "seed=0 step=7"
    assert "nowhere.py: no such file; expected a Python file" in said["nowhere.py"]


def test_run_and_sweep_print_what_the_population_counts(plugin, call, tmp_path):
    options = ("--set", "cells=pose+draws", "--stop", 5, "--plugin", plugin)
    done = call("run", WORLD, *options, "--no-tensorboard", "--out", tmp_path / "run")
    assert "\ndraws 5\n" in done.out
    done = call("sweep", WORLD, *options, "--vary", "draws.step=1,2", "--out", tmp_path / "sweep")
    lines = done.out.splitlines()
    head = next(line for line in lines if "draws.step" in line)
    column = [cell.strip() for cell in head.split("┃")].index("draws")
    rows = [[cell.strip() for cell in line.split("│")] for line in lines if line.startswith("│")]
    assert [row[column] for row in rows] == ["5", "10"]


def test_without_its_file_a_run_and_a_brain_say_how_to_give_it(plugin, call, mistake, tmp_path):
    out, options = tmp_path / "run", ("--set", "cells=pose+draws", "--stop", 10, "--no-tensorboard")
    assert call("run", WORLD, *options, "--out", out, "--plugin", plugin).code == 0
    del populations.registered["draws"]
    populations._loaded.clear()
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(populations.PLUGINS, "")
        for command in (
            ("inspect", out),
            ("resume", out),
            ("run", WORLD, *options, "-o", out / "2"),
        ):
            told = mistake(*command)
            assert "unknown population 'draws'" in told
            assert "--plugin FILE" in told
        told = mistake("run", WORLD, "--set", "draws.step=2", "-o", out / "2")
        assert "unknown key 'draws'" in told
        assert "--plugin FILE" in told
        assert call("inspect", out, "--plugin", plugin).code == 0


# --- a leader ------------------------------------------------------------------------------------


class Squares(Population):
    """Leads by dead reckoning: each square of the floor is an experience."""

    rank = 7
    growing = ("squares",)
    merge_rules: ClassVar = {"squares": rows_of_experiences, "pose": about_now}
    side_m = 0.5

    def __init__(self):
        super().__init__()
        self.register_buffer("squares", torch.zeros((0, 2), dtype=torch.int64))
        self.register_buffer("pose", torch.zeros(3, dtype=torch.float64))

    def step(self, now, observation):
        x, y, theta = self.pose.tolist()
        theta += now.motion.w_rad_s * now.motion.dt_s
        d = now.motion.v_m_s * now.motion.dt_s
        self.pose = torch.tensor(
            [x + d * math.cos(theta), y + d * math.sin(theta), theta], dtype=torch.float64
        )

    def decide(self, map_, now):
        here = (self.pose[:2] / self.side_m).floor().to(torch.int64)
        known = (self.squares == here).all(1).nonzero()
        if not len(known):
            self.squares = torch.cat([self.squares, here[None]])
        square = int(known[0]) if len(known) else len(self.squares) - 1
        return Decision(*map_.visit(square, self._pose, now.motion.dt_s, now.frame))

    @property
    def _pose(self) -> Pose:
        return Pose(*self.pose.tolist())

    def belief(self, map_):
        return Belief(self._pose)

    @property
    def estimate(self):
        return PoseEstimate(*self.pose.tolist())

    def match(self, loaded, maps, config):
        pairs = [
            (mine, theirs, 0.0, 0.0)
            for mine, square in enumerate(self.squares.tolist())
            for theirs, other in enumerate(loaded.squares.tolist())
            if square == other
        ]
        if not pairs:
            return None, "they have no square in common"
        onto = Pose(*maps[1][pairs[0][0]])
        return (
            Match(pairs[0][1], pairs[0][0], others=Pairs.of(pairs[1:]), onto=onto),
            f"{len(pairs)} squares are the same",
        )


@pytest.fixture
def squares():
    register("squares")(Squares)
    yield BrainConfig(cells="squares")
    del populations.registered["squares"]


def drive(path, turn_at):
    """Three metres east; and from a frame on, north."""
    rows = [f"{0.1 * k},0.5,{math.pi / 2 / 0.1 if k == turn_at else 0.0}" for k in range(60)]
    path.write_text("\n".join(["time_s,v_m_s,w_rad_s", *rows]) + "\n")
    return path


def test_a_leader_of_ones_own_makes_the_map_is_saved_and_goes_on(squares, tmp_path):
    source = drive(tmp_path / "east.csv", -1)
    run(source, tmp_path / "whole", squares, tensorboard=False)
    run(source, tmp_path / "cut", squares, stop=25, tensorboard=False)
    resume(tmp_path / "cut", tensorboard=False)
    whole, cut = (load_brain(tmp_path / n / "brain.safetensors") for n in ("whole", "cut"))
    assert equal(whole, cut)
    assert type(whole.leader) is Squares
    assert whole.map.n == len(whole.squares.squares) == 6  # of half a metre each
    assert whole.map.pose == pytest.approx((0.5 * (0.05 + 59 * 0.1), 0.0, 0.0), abs=1e-9)
    assert verify(tmp_path / "whole") == []


def test_a_leader_of_ones_own_says_where_two_maps_meet(squares, tmp_path):
    for name, turn_at in (("east", -1), ("north", 30)):
        source = drive(tmp_path / f"{name}.csv", turn_at)
        run(source, tmp_path / name, squares, tensorboard=False)
    merged, (report,) = merge_runs(tmp_path / "east", tmp_path / "north", tmp_path / "both")
    assert merged is not None, report
    assert report.found.endswith("squares are the same")
    brains = {n: load_brain(tmp_path / n / "brain.safetensors") for n in ("east", "north", "both")}
    found = {name: set(map(tuple, b.squares.squares.tolist())) for name, b in brains.items()}
    assert found["both"] == found["east"] | found["north"]
    assert brains["both"].map.n == len(found["both"])
    at = (brains["both"].map.poses[:, :2] / Squares.side_m).round()
    assert np.abs(at - brains["both"].squares.squares.numpy()).max() <= 1.0
    assert brains["both"].map.pose == pytest.approx(brains["north"].map.pose)
    assert verify(tmp_path / "both") == []


def test_a_leader_of_ones_own_that_finds_no_common_place_says_why(squares, tmp_path):
    run(drive(tmp_path / "a.csv", -1), tmp_path / "a", squares, tensorboard=False)
    run(tmp_path / "a.csv", tmp_path / "b", squares, tensorboard=False, start=1)
    first, second = (load_brain(tmp_path / n / "brain.safetensors") for n in "ab")
    second.squares.squares = second.squares.squares + 100
    save_brain(second, tmp_path / "b.safetensors")
    merged, (report,) = merge_runs(tmp_path / "a", tmp_path / "b.safetensors", tmp_path / "c")
    assert merged is None
    assert report.reason == "they have no square in common"
    assert first.map.n


# --- what goes wrong -----------------------------------------------------------------------------


@pytest.fixture
def odd():
    """Register a population with these hooks; unregister it afterwards."""

    def make(**hooks):
        cls = type("Odd", (Population,), hooks)
        register("odd")(cls)
        return BrainConfig(cells="pose+odd")

    yield make
    populations.registered.pop("odd", None)


@pytest.mark.parametrize("hook", ["step", "recall"])
def test_a_hook_that_returns_no_correction_is_named(hook, odd, frames):
    config = odd(**{hook: lambda *_: 0.1})
    with pytest.raises(TypeError, match=r"Odd: step\(\) or recall\(\) returned float, expected"):
        driven(config, frames[:1])


def test_a_frame_that_observe_refuses_changes_nothing(odd, frames):
    from neuroslam.errors import BadFrame

    def observe(_, frame):
        if frame.index == 5:
            raise BadFrame("odd")

    brain = driven(odd(observe=observe), frames[:5])
    before = copy.deepcopy(brain)
    with pytest.raises(BadFrame, match="frame 5: odd"):
        brain(frames[5])
    assert equal(before, brain)
    brain(frames[6])


def test_a_population_without_views_gets_none_where_no_one_makes_any(odd, frames):
    shown = []
    config = odd(learn=lambda _, now, __: shown.append(now.view.template))
    config = config.model_copy(update={"cells": ("place", "odd")})
    driven(config, frames[:5])
    assert shown == [NO_TEMPLATE] * 5


def test_one_that_needs_views_gets_them_under_any_leader(odd, frames):
    shown = []
    config = odd(needs_views=True, learn=lambda _, now, __: shown.append(now.view.template))
    config = config.model_copy(update={"cells": ("place", "odd")})
    brain = driven(config, frames[:30])
    assert max(shown) == brain.view.n - 1 > 0


class Predictor(Population):
    """Learns by gradient to tell the speed from the turn rate."""

    merge_rules: ClassVar = {"layer": about_now}

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.layer = nn.Linear(1, 1)

    def learn(self, now, observation):
        with torch.inference_mode(False), torch.enable_grad():
            loss = (self.layer(torch.zeros(1)) - now.motion.v_m_s).square().sum()
            slopes = torch.autograd.grad(loss, list(self.layer.parameters()), allow_unused=True)
            with torch.no_grad():
                for weight, slope in zip(self.layer.parameters(), slopes, strict=True):
                    weight -= 0.1 * slope

    @property
    def guess(self) -> Tensor:
        return self.layer(torch.zeros(1))


def test_one_that_learns_by_gradient_may_and_is_saved(frames, tmp_path):
    register("predictor")(Predictor)
    try:
        brain = driven(BrainConfig(cells="pose+predictor"), frames[:60])
        assert brain.predictor.guess.item() == pytest.approx(frames[59].velocity.v_m_s, rel=0.05)
        save_brain(brain, tmp_path / "brain.safetensors")
        other = load_brain(tmp_path / "brain.safetensors")
        for frame in frames[60:70]:
            brain(frame)
            other(frame)
        assert equal(brain, other)
    finally:
        del populations.registered["predictor"]
