"""Side by side, work gives what it gives one after the other, and an end is an end."""

import math
import os
import signal
import subprocess
import sys
import time

import cv2
import pytest
import torch

from neuroslam import workers
from neuroslam.config import read_preset
from neuroslam.errors import ConfigError, NeuroslamError, RunError
from neuroslam.runs.parallel import outcomes, parallel_map
from neuroslam.runs.sweep import parse_values


def test_results_come_in_the_order_of_the_items():
    assert parallel_map(math.sqrt, [9.0, 4.0, 1.0]) == [3.0, 2.0, 1.0]
    assert parallel_map(math.sqrt, [9.0, 4.0, 1.0], jobs=2) == [3.0, 2.0, 1.0]
    assert parallel_map(math.sqrt, [], jobs=2) == []


@pytest.mark.parametrize("start", ["spawn", workers.START_METHOD])
def test_processes_are_others_and_have_one_thread(start, monkeypatch):
    monkeypatch.setattr(workers, "START_METHOD", start)
    monkeypatch.setenv("SET_LATER", "yes")
    (threads,) = parallel_map(eval, ["__import__('torch').get_num_threads()"])
    ours, *theirs = (parallel_map(eval, ["__import__('os').getpid()"] * 2, jobs=n) for n in (1, 2))
    assert threads == 1
    assert ours == [os.getpid()] * 2
    assert os.getpid() not in theirs[0]
    questions = ["__import__('torch').get_num_threads()", "__import__('cv2').getNumThreads()"]
    assert parallel_map(eval, questions, jobs=2) == [1, 1]
    later = "__import__('os').environ['SET_LATER']"
    assert parallel_map(eval, [later] * 2, jobs=2) == ["yes"] * 2


def test_threads_are_as_they_were_afterwards():
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(2)
    try:
        parallel_map(abs, [1])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before[0])
    assert cv2.getNumThreads() == before[1]


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_error_of_a_users_stops_only_its_item(jobs):
    texts = ["a=1,2", "b", "c=3"]
    found = dict(outcomes(parse_values, texts, jobs))
    assert found[0], found[2] == (("a", [1, 2]), ("c", [3]))
    assert isinstance(found[1], ConfigError)
    assert "--vary 'b'" in str(found[1])
    with pytest.raises(ConfigError, match="unknown preset 'none'"):
        parallel_map(read_preset, ["full", "none"], jobs)


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_bug_is_raised_as_it_is(jobs):
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        parallel_map(math.sqrt, [4.0, -1.0], jobs)


def test_a_process_that_dies_takes_no_other_item_with_it():
    lines = ["1", "__import__('os')._exit(9)", "3"]
    found = dict(outcomes(eval, lines, jobs=2))
    assert (found[0], found[2]) == (1, 3)
    assert isinstance(found[1], RunError)
    assert "its process died" in str(found[1])


def test_jobs_below_one_are_a_mistake():
    with pytest.raises(NeuroslamError, match="jobs is 0; expected 1 or more"):
        parallel_map(abs, [1], jobs=0)


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RunError, match=r"pip install neuroslam\[sweep\], or omit --ray"):
        parallel_map(abs, [1], ray="local")


_CUT_OFF = """
import sys, time
from neuroslam.runs.parallel import parallel_map
if __name__ == "__main__":
    parallel_map(exec, ["import os, time; print(os.getpid(), flush=True); time.sleep(60)"] * 3, 2)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_when_the_parent_ends_its_processes_end(how, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(_CUT_OFF)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    with parent:
        children = [int(parent.stdout.readline()) for _ in range(2)]
        parent.send_signal(how)
        assert parent.wait(120) != 0
    for _ in range(1200):
        if not any(map(_lives, children)):
            break
        time.sleep(0.1)
    assert not any(map(_lives, children))


def _lives(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False
