import subprocess
import sys

import pytest
import torch

from neuroslam.view import vision


def run_fresh(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_module_does_not_import_torchvision():
    code = "import sys, neuroslam.view.vision; print('torchvision' in sys.modules)"
    assert run_fresh(code) == "False"


def test_a_fresh_process_gets_grids_and_transforms_through_it_and_may_then_import_torchvision():
    code = """
import torch
from neuroslam.view.vision import make_grid, transforms
import torchvision
print(tuple(make_grid(torch.zeros(4, 3, 5, 6), nrow=2, padding=1).shape))
print(tuple(transforms.Resize((2, 3))(torch.zeros(1, 8, 8)).shape))
"""
    assert run_fresh(code).split("\n") == ["(3, 13, 15)", "(1, 2, 3)"]


def test_it_mends_what_a_failed_bare_import_left_behind():
    code = """
try:
    import torchvision
except RuntimeError:
    pass
from neuroslam.view import vision
print(vision.load().extension._has_ops() in (True, False), vision.make_grid.__name__)
"""
    assert run_fresh(code) == "True make_grid"


def test_loading_twice_gives_the_same_module():
    assert vision.load() is vision.load() is sys.modules["torchvision"]


def test_operators_that_did_not_load_still_say_so_when_called():
    if vision.load().extension._has_ops():
        pytest.skip("this torchvision has its operators")
    with pytest.raises(RuntimeError, match="Couldn't load custom C\\+\\+ ops"):
        vision.load().ops.nms(torch.zeros(1, 4), torch.zeros(1), 0.5)


def test_another_name_is_refused_like_in_any_module():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = vision.nothing
