"""What a release needs agrees with pyproject.toml; the package runs without what draws and logs."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import neuroslam

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
CONDA_NAMES = {
    "torch": "pytorch",
    "opencv-python-headless": "py-opencv",
    "matplotlib": "matplotlib-base",
}
IMPORT_SECONDS = 0.2


def recipe():
    """Return the conda-forge recipe as conda-build reads it: a template of YAML."""
    jinja2, yaml = pytest.importorskip("jinja2"), pytest.importorskip("yaml")
    text = (ROOT / "packaging/conda-forge/meta.yaml").read_text("utf-8")
    strict = jinja2.Environment(undefined=jinja2.StrictUndefined)
    return yaml.safe_load(strict.from_string(text).render(PYTHON="python"))


def test_the_recipe_has_the_dependencies_of_the_package():
    ours = [re.fullmatch(r"([\w-]+)(.*)", each).groups() for each in PROJECT["dependencies"]]
    expected = {f"{CONDA_NAMES.get(name, name)} {bound}" for name, bound in ours}
    assert set(recipe()["requirements"]["run"]) == {"python >=3.11", *expected}


def test_every_file_has_the_same_version_and_commands():
    version = neuroslam.__version__
    assert PROJECT["version"] == recipe()["package"]["version"] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    points = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe()["build"]["entry_points"] == points


def test_the_container_copies_what_the_package_is_built_from():
    text = (ROOT / "Dockerfile").read_text("utf-8")
    copied = {word for line in re.findall(r"^COPY (.+) \S+$", text, re.M) for word in line.split()}
    assert all((ROOT / name).exists() for name in copied)
    assert {"pyproject.toml", "neuroslam", "configs", PROJECT["readme"]} <= copied
    assert set(PROJECT["license-files"]) <= copied
    ignored = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert not copied & set(ignored)


def test_a_brain_runs_without_what_only_draws_and_logs(tmp_path):
    program = """
import sys
for name in ("matplotlib", "torchvision", "tensorboard", "torch.utils.tensorboard"):
    sys.modules[name] = None  # importing it fails
from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
brain = NavigationBrain(BrainConfig())
for frame in open_source("world:corridor").frames(stop=5):
    brain(frame)
save_brain(brain, "brain.safetensors")
print(load_brain("brain.safetensors").clock.frames_seen)
"""
    plain = os.environ | {"NEUROSLAM_COMPILED": "0", "PYTHONPATH": str(ROOT)}  # nothing to compile
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=plain,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "5", done.stderr


def test_importing_the_package_is_fast():
    program = (
        "import sys, time; start = time.process_time(); import neuroslam; "
        "print(time.process_time() - start, 'torch' in sys.modules, 'numpy' in sys.modules)"
    )
    command = [sys.executable, "-c", program]
    rows = [subprocess.check_output(command, cwd=ROOT, text=True).split() for _ in range(3)]
    assert min(float(seconds) for seconds, *_ in rows) <= IMPORT_SECONDS
    assert rows[0][1:] == ["False", "False"]  # neither torch nor numpy is loaded
