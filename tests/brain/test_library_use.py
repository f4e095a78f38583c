"""In a Python program a brain is copied, sent to processes and run beside other uses of torch."""

import copy
import importlib
import io
import os
import pickle
import subprocess
import sys
import textwrap

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import BrainConfig, build_config, read_preset
from neuroslam.sensors import open_source
from neuroslam.state.tables import GrowingTable
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Velocity

CORRIDOR = "world:corridor?laps=1&odometry=true&width=64&height=40"
ARENA = "arena:square"
HEADING = BrainConfig(cells=("pose", "head_direction", "speed"))
KINDS = {
    "ratslam": (BrainConfig(), CORRIDOR),
    "slrb": (build_config(read_preset("slrb"), "slrb"), ARENA),
    "full": (build_config(read_preset("full"), "full"), CORRIDOR),
    "heading": (HEADING, CORRIDOR),
}


def frames_of(source, start=0, stop=None):
    return list(open_source(source).frames(start, stop))


def seen_by(config, source, stop=30):
    brain = NavigationBrain(config)
    for frame in frames_of(source, 0, stop):
        brain(frame)
    return brain


def through_torch(brain):
    file = io.BytesIO()
    torch.save(brain, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


def through_ray(brain):
    cloudpickle = pytest.importorskip("ray.cloudpickle", reason="needs the extra sweep")
    return cloudpickle.loads(cloudpickle.dumps(brain))


def read_only(brain):
    """As joblib and Ray hand arrays over: out of band, in memory that cannot be written."""
    buffers = []
    data = pickle.dumps(brain, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(data, buffers=[bytes(buffer.raw()) for buffer in buffers])


WAYS = {
    "pickle": lambda brain: pickle.loads(pickle.dumps(brain)),
    "deepcopy": copy.deepcopy,
    "torch.save": through_torch,
    "ray": through_ray,
    "read-only": read_only,
}


def require_equal_states(one, other):
    a, b = one.state_dict(), other.state_dict()
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype
        assert torch.equal(a[name], b[name]), name


@pytest.mark.parametrize(
    ("kind", "way"),
    [
        *(("ratslam", way) for way in WAYS),
        *((kind, way) for kind in ("slrb", "full", "heading") for way in ("pickle", "deepcopy")),
    ],
)
def test_a_brain_that_was_sent_goes_on_bit_for_bit(kind, way):
    config, source = KINDS[kind]
    brain = seen_by(config, source)
    sent = WAYS[way](brain)
    require_equal_states(brain, sent)
    before = {name: value.clone() for name, value in brain.state_dict().items()}
    after = [sent(frame) for frame in frames_of(source, 30, 45)]
    for name, value in brain.state_dict().items():  # they share no memory
        assert torch.equal(value, before[name]), name
    assert [str(brain(frame)) for frame in frames_of(source, 30, 45)] == list(map(str, after))
    require_equal_states(brain, sent)


def test_stored_maps_and_a_pending_gap_are_sent_too():
    ellipse = "world:ellipse?laps=2&width=256&height=64"
    first, brain = NavigationBrain(), NavigationBrain()
    for frame in frames_of(ellipse, 0, 300):
        first(frame)
    brain.store(first)
    brain.about = ("drive", "rc_car", "2026-01-01")
    sent = pickle.loads(pickle.dumps(brain))
    assert sent.about == brain.about
    assert len(sent.stored) == 1
    frames = frames_of(ellipse, 320, 450)
    assert [str(sent(frame)) for frame in frames] == [str(brain(frame)) for frame in frames]
    assert len(sent.sessions.merges) == len(brain.sessions.merges) == 1


class OwnBrain(NavigationBrain):
    """A subclass with an argument, an attribute and a part of its own."""

    def __init__(self, label):
        super().__init__(BrainConfig())
        self.label = label
        self.readout = nn.Linear(2, 3)


def test_a_subclass_keeps_what_it_has_of_its_own():
    brain = OwnBrain("mine")
    brain(frames_of(CORRIDOR, 0, 1)[0])
    for way in ("pickle", "deepcopy", "torch.save"):
        sent = WAYS[way](brain)
        assert type(sent) is OwnBrain
        assert sent.label == "mine"
        assert torch.equal(sent.readout.weight, brain.readout.weight)
        require_equal_states(brain, sent)


@pytest.mark.parametrize("kind", KINDS)
def test_every_part_can_be_sent_alone(kind):
    brain = seen_by(*KINDS[kind])
    for name, part in brain.named_children():
        sent = pickle.loads(pickle.dumps(part))
        require_equal_states(part, sent)
        assert type(sent) is type(part), name
    sent = pickle.loads(pickle.dumps(brain.map))
    n = sent.n
    sent.experiences["pose"][:] = 7.0
    assert (sent.experiences.array("pose") == 7.0).all()
    assert not (brain.map.experiences.array("pose") == 7.0).any()
    assert sent.n == n


def test_a_part_that_was_found_is_not_doubled_by_a_copy():
    brain = seen_by(*KINDS["ratslam"], stop=3)
    assert "view" in brain.__dict__  # found once, kept
    copied = copy.deepcopy(brain)
    assert copied.view is copied._modules["view"]
    assert copied.view is not brain.view
    part = pickle.loads(pickle.dumps(brain.map))
    assert part.state is part._modules["state"]


def test_a_table_that_was_sent_is_written_alone():
    table = GrowingTable({"x": ((), torch.float64), "y": ((2,), torch.float32)})
    for k in range(20):
        table.append(x=float(k), y=torch.tensor([k, -k]))
    whole = table.array("x")
    sent = pickle.loads(pickle.dumps(table))
    sent.append(x=99.0, y=torch.zeros(2))
    sent["x"][0] = -1.0
    assert sent.array("x")[0] == -1.0
    assert (len(table), table["x"][0].item(), whole[0]) == (20, 0.0, 0.0)


def test_a_half_taken_brain_is_refused_with_its_reason():
    brain = seen_by(*KINDS["ratslam"], stop=3)
    brain.half_taken = "frame 3 is half taken: restore a state saved before it"
    with pytest.raises(RuntimeError, match="frame 3 is half taken"):
        pickle.dumps(brain)


def test_a_checkpoint_of_a_sent_brain_is_that_of_the_first(tmp_path):
    brain = seen_by(*KINDS["full"])
    save_brain(brain, tmp_path / "a")
    save_brain(pickle.loads(pickle.dumps(brain)), tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    load_brain(tmp_path / "b")


def run_script(tmp_path, text, **environment):
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(text))
    env = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300,
        env=env | environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


SPAWN = """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from neuroslam import BrainConfig, NavigationBrain, open_source

    SOURCE = "world:corridor?laps=1&odometry=true&width=64&height=40"

    def go_on(brain):
        return [str(brain(frame)) for frame in open_source(SOURCE).frames(30, 60)], brain

    if __name__ == "__main__":
        brain = NavigationBrain(BrainConfig(cells=("pose", "head_direction", "speed")))
        for frame in open_source(SOURCE).frames(0, 30):
            brain(frame)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, context) as pool:
            results, back = pool.submit(go_on, brain).result()
        assert brain.clock.frames_seen == 30
        assert results == go_on(brain)[0]
        assert back.map.n == brain.map.n
        assert back.clock.frames_seen == 60
        print("ok")
"""


def test_a_spawned_process_goes_on_with_a_brain_and_leaves_the_first_alone(tmp_path):
    assert run_script(tmp_path, SPAWN) == ["ok"]


FORK = """
    import os, signal, sys, torch
    from neuroslam import BrainConfig, NavigationBrain, open_source
    from neuroslam.config import build_config, read_preset

    SOURCE = "world:corridor?laps=1&odometry=true&width=64&height=40"
    torch.set_num_threads(2)
    config = build_config(read_preset("full"), "full")
    frames = list(open_source(SOURCE).frames(stop=24))
    brain = NavigationBrain(config)
    for frame in frames[:12]:
        brain(frame)
    torch.rand(2_000_000).exp().sum()  # parallel in the parent
    torch.fft.rfftn(torch.rand(64, 64, 64))
    pid = os.fork()
    if pid == 0:
        signal.alarm(60)
        assert torch.get_num_threads() == 1
        for frame in frames[12:]:
            brain(frame)
        other = NavigationBrain(config)  # made in the child
        other(frames[0])
        torch.rand(2_000_000).exp().sum()
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), torch.get_num_threads())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_goes_on_with_a_brain(tmp_path):
    assert run_script(tmp_path, FORK) == ["0", "2"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_the_case_of_a_fork_ends(shared):
    case = shared / "cases" / "hang_after_fork" / "f.py"
    if not case.is_file():
        pytest.skip("no cases beside the checkout")
    env = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, str(case)], capture_output=True, text=True, timeout=120, env=env,
        check=False,
    )  # fmt: skip
    assert done.stdout.strip() == "child ended with 0", done.stderr


def test_the_case_of_a_pickle_works(shared):
    case = shared / "cases" / "brain_cannot_be_pickled" / "p.py"
    if not case.is_file():
        pytest.skip("no cases beside the checkout")
    exec(compile(case.read_text(), str(case), "exec"), {})


# --- threads and types ---------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [1, 2])
def test_a_brain_takes_its_threads_and_gives_the_callers_back(threads, monkeypatch):
    brain = NavigationBrain(BrainConfig(threads=threads))
    used = []
    take = brain._take

    def noting(frame):
        used.append((torch.get_num_threads(), cv2.getNumThreads()))
        return take(frame)

    monkeypatch.setattr(brain, "_take", noting)
    with limit_threads(3):
        brain(frames_of(CORRIDOR, 0, 1)[0])
        with pytest.raises(ValueError, match="image is"):
            brain(Frame(1, 0.5, np.zeros((2, 2)), Velocity(0.0, 0.0)))
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (3, 3)
    assert used == [(threads, threads)] * 2


@pytest.mark.parametrize("kind", ["full", "slrb"])
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_around_a_brain_changes_nothing(kind, dtype):
    config, source = KINDS[kind]
    plain = seen_by(config, source, 15)
    with torch.autocast("cpu", dtype=dtype):
        cast = seen_by(config, source, 15)
        assert torch.is_autocast_enabled("cpu")
    require_equal_states(plain, cast)


@pytest.mark.parametrize(
    "convert",
    [
        lambda m: m.half(),
        lambda m: m.bfloat16(),
        lambda m: m.to(torch.float16),
        lambda m: m.double(),
        lambda m: m.float(),
    ],
)
def test_a_brain_keeps_its_types_and_says_so(convert):
    brain = seen_by(*KINDS["full"], stop=5)
    before = copy.deepcopy(brain)
    with pytest.raises(
        TypeError, match=r"cannot be converted from torch.float.* use .to\(device\)"
    ):
        convert(brain)
    require_equal_states(brain, before)
    assert brain.to("cpu") is brain


def test_cells_take_64_bits_and_refuse_16_and_tables_keep_their_own():
    brain = seen_by(*KINDS["slrb"], stop=5)
    with pytest.raises(TypeError, match=r"too few digits .* expected torch.float32 or"):
        brain.navigation.half()
    brain.map.half()
    poses = brain.map.experiences["pose"].clone()
    brain.map.float()
    assert brain.map.experiences["pose"].dtype == torch.float64
    assert torch.equal(brain.map.experiences["pose"], poses)
    assert torch.equal(torch.from_numpy(brain.map.experiences.array("pose")), poses)


def test_importing_the_package_alone_changes_no_threads():
    before = torch.get_num_threads()
    importlib.import_module("neuroslam.threads")
    assert torch.get_num_threads() == before
