"""Brain files: complete, checked, written whole or not at all."""

import json
import pickle
import subprocess
import sys
import warnings
from functools import cache

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from neuroslam.brain import NavigationBrain, load_brain, read_checkpoint, save_brain
from neuroslam.brain.checkpoint import FORMAT_VERSION
from neuroslam.brain.soundness import _expected, _fits, _surely_connected, faults_of
from neuroslam.config import BrainConfig
from neuroslam.errors import CheckpointError
from neuroslam.mapping.tables import Links
from neuroslam.sensors import open_source
from neuroslam.state.files import save_checked, tensors_digest
from neuroslam.types import Frame

WORLD = "world:corridor?laps=2&noise=0.05"
CONFIG = BrainConfig(max_gap_s=5.0, map={"rest_tolerance": 0.0})


@cache
def rendered() -> list[Frame]:
    return list(open_source(WORLD).frames(0, 360))


def lived(frames: int) -> NavigationBrain:
    brain = NavigationBrain(CONFIG)
    for frame in rendered()[:frames]:
        brain(frame)
    return brain


@pytest.fixture(scope="module")
def brain():
    return lived(60)


@pytest.fixture
def saved(brain, tmp_path):
    path = tmp_path / "brain.safetensors"
    save_brain(brain, path)
    return path


def test_what_is_saved_is_what_is_loaded(brain, saved):
    copy = load_brain(saved)
    assert copy.config == brain.config
    state = copy.state_dict()
    for name, tensor in brain.state_dict().items():
        assert torch.equal(state[name], tensor), name
        assert state[name].dtype == tensor.dtype, name


def test_two_saves_of_one_brain_are_equal_files(brain, saved, tmp_path):
    save_brain(brain, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == saved.read_bytes()


@pytest.mark.parametrize("stop", [1, 345])
def test_going_on_in_a_new_process_is_bit_equal_to_never_having_stopped(stop, tmp_path):
    """Before a first loop, and after loop closures (a lap has 340 frames)."""
    end = stop + 15
    save_brain(lived(stop), tmp_path / "cut.safetensors")
    save_brain(lived(end), tmp_path / "whole.safetensors")
    program = (
        "import sys, torch; torch.set_num_threads(1);"
        "from neuroslam.brain import load_brain, save_brain;"
        "from neuroslam.sensors import open_source;"
        "brain = load_brain(sys.argv[1]);"
        f"[brain(f) for f in open_source({WORLD!r}).frames({stop}, {end})];"
        "save_brain(brain, sys.argv[2])"
    )
    command = [sys.executable, "-c", program, tmp_path / "cut.safetensors", tmp_path / "on"]
    subprocess.run(command, check=True)
    assert (tmp_path / "on").read_bytes() == (tmp_path / "whole.safetensors").read_bytes()


def test_a_file_with_old_names_in_its_config_loads_without_a_warning(brain, tmp_path):
    written = brain.config.model_dump(mode="json")
    for old, new in (("carried", "kidnapped"), ("carried_factor", "kidnapped_factor")):
        written["sessions"][old] = written["sessions"].pop(new)
    written["sessions"]["carried"] = "ignore"
    path = tmp_path / "old.safetensors"
    save_checked(path, {"format": FORMAT_VERSION, "config": written}, brain.state_dict())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        copy = load_brain(path)
    assert told == []
    sessions = brain.config.sessions.model_copy(update={"kidnapped": "ignore"})
    assert copy.config == brain.config.model_copy(update={"sessions": sessions})


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CheckpointError, match=r"nowhere\.safetensors: no such brain file"):
        load_brain(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize("keep", [0, 5, 100, 0.5, 0.999])
def test_a_truncated_file_is_refused(saved, keep):
    content = saved.read_bytes()
    saved.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    with pytest.raises(CheckpointError, match=r"brain\.safetensors: (truncated|damaged)"):
        load_brain(saved)


def test_any_flipped_bit_is_noticed(saved):
    content = bytearray(saved.read_bytes())
    places = np.random.default_rng(0).integers(8, len(content), 40)
    for at in places:
        flipped = bytearray(content)
        flipped[at] ^= 0x10
        saved.write_bytes(flipped)
        with pytest.raises(CheckpointError, match=r"brain\.safetensors"):
            load_brain(saved)


def test_a_newer_format_asks_for_an_upgrade(brain, tmp_path):
    path = tmp_path / "newer.safetensors"
    about = {"format": 99, "config": {}, "sha256": "0"}
    save_file({"a": torch.zeros(1)}, path, metadata={"neuroslam": json.dumps(about)})
    with pytest.raises(
        CheckpointError, match=r"format 99, this neuroslam reads up to \d+; upgrade"
    ):
        load_brain(path)


def test_another_safetensors_file_is_not_a_brain(tmp_path):
    save_file({"a": torch.zeros(1)}, tmp_path / "other")
    with pytest.raises(CheckpointError, match="not one that neuroslam wrote"):
        load_brain(tmp_path / "other")


def test_a_pickle_is_refused_and_never_run(brain, tmp_path):
    for name, content in (("torch", None), ("plain", pickle.dumps({"a": 1}))):
        path = tmp_path / name
        if content is None:
            torch.save(brain.state_dict(), path)
        else:
            path.write_bytes(content)
        with pytest.raises(CheckpointError, match="a pickle"):
            load_brain(path)


def test_a_state_that_does_not_fit_its_config_is_refused(brain, tmp_path):
    path = tmp_path / "odd.safetensors"
    save_brain(brain, path)
    config, tensors = read_checkpoint(path)
    tensors.pop("map.state.dx_m")
    about = {
        "format": FORMAT_VERSION,
        "config": config.model_dump(mode="json"),
    }
    save_checked(path, about, tensors)
    with pytest.raises(CheckpointError, match="does not fit its config"):
        load_brain(path)


def test_a_failed_save_leaves_the_old_brain(brain, saved, monkeypatch):
    before = saved.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("neuroslam.state.files.save_file", full)
    with pytest.raises(OSError, match="No space left"):
        save_brain(brain, saved)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == [saved.name]


def test_the_file_holds_tensors_and_text_only(saved):
    with safe_open(saved, framework="pt") as file:
        assert list(file.metadata()) == ["neuroslam"]
        assert json.loads(file.metadata()["neuroslam"])["format"] == FORMAT_VERSION


def test_a_file_whose_first_byte_is_a_pickles_is_read_all_the_same(tmp_path):
    """The first bytes are the header's length: of 256 files one begins as a pickle does."""
    path, config = tmp_path / "brain.safetensors", BrainConfig()
    brain = NavigationBrain(config)
    for length in range(256):
        brain.about = ("x" * length, "", "")
        brain._name_session(Frame(0, 0.0), {})
        brain.sessions.sessions = brain.sessions.sessions[-1:]
        about = {"format": FORMAT_VERSION, "config": config.model_dump(mode="json")}
        tensors = brain.state_dict()
        about["padding"] = "x" * length
        save_checked(path, about, tensors)
        if path.read_bytes()[0] == 0x80:
            assert load_brain(path).config == config
            return
    pytest.fail("no length of the header begins with 0x80")


def test_a_brain_of_the_first_format_is_one_session(brain, tmp_path):
    tensors = brain.state_dict()
    old = {
        name: tensor
        for name, tensor in tensors.items()
        if not name.startswith(("sessions.", "recognition.", "map.aliases."))
        and name not in ("map.experiences.session", "map.experiences.number")
        and name not in ("map.state.session", "map.state.made", "continuity.state.recent")
    }
    n_blocks = brain.view.geometry.n_blocks
    old["view.templates.blocks"] = old["view.templates.blocks"][:, :n_blocks].contiguous()
    config = brain.config.model_dump(mode="json")
    del config["sessions"]
    about = {"format": 1, "config": config, "sha256": tensors_digest(old)}
    save_file(old, tmp_path / "old", metadata={"neuroslam": json.dumps(about)})
    loaded = load_brain(tmp_path / "old")
    state = loaded.state_dict()
    for name in old:
        assert torch.equal(state[name], tensors[name]), name
    assert state["continuity.state.recent"] == 0.0  # as after a calm drive
    origins = loaded.map.origins()
    assert origins.number.tolist() == list(range(brain.map.n))
    assert set(origins.session.tolist()) == {loaded.sessions.now.id}
    assert loaded.map.state.made == brain.map.n


# --- quick checks -------------------------------------------------------------------------------


@pytest.mark.parametrize("cells", ["pose", "pose+place+semantic+head_direction+speed"])
def test_a_new_brain_is_found_sound_by_the_quick_check_and_no_altered_one(cells):
    values = {"cells": cells, "semantic": {"space": {"n_scales": 2, "n_rotations": 2}}}
    brain = NavigationBrain(BrainConfig.model_validate(values))
    state, expected = dict(brain.state_dict()), _expected(brain)
    assert _fits(state, expected)
    for name, tensor in state.items():
        rest = {key: value for key, value in state.items() if key != name}
        assert not _fits(rest, expected)
        assert not _fits(rest | {f"{name}_": tensor}, expected)
        assert not _fits(state | {name: tensor.unsqueeze(0)}, expected)
        assert not _fits(state | {name: tensor.to(torch.float16)}, expected)
    assert not _fits(
        state | {"map.links_table.source": torch.zeros(1, dtype=torch.int64)}, expected
    )


def test_time_that_no_step_has_taken_is_less_than_a_step():
    values = {"cells": "semantic", "semantic": {"space": {"n_scales": 2, "n_rotations": 2}}}
    brain = NavigationBrain(BrainConfig.model_validate(values))
    state = dict(brain.state_dict())
    assert not list(faults_of(state, brain))
    altered = state | {"semantic.now.owed_s": torch.tensor(-1.0, dtype=torch.float64)}
    assert any("now.owed_s: -1.0 s, expected 0 to" in fault for fault in faults_of(altered, brain))


@pytest.mark.parametrize(
    ("source", "target", "connected"),
    [([0, 1], [1, 2], True), ([2, 0], [0, 1], True), ([0, 2], [1, 2], False), ([0], [1], False),
     ([0, 1], [1, 3], False), ([0, -1], [1, 2], False)],
)  # fmt: skip
def test_a_map_is_surely_connected_if_each_experience_is_linked_to_an_earlier_one(
    source, target, connected
):
    empty = [np.zeros(len(source))] * (len(Links._fields) - 2)
    assert _surely_connected(Links(np.array(source), np.array(target), *empty), 3) == connected
