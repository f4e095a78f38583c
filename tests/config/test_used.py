"""Every parameter is read: one that nothing reads is a promise that is not kept."""

import ast
import inspect
from functools import cache
from pathlib import Path

import pytest
import torch

import neuroslam
import neuroslam.compiled as switch
from neuroslam.cells.head_direction import HeadDirectionConfig
from neuroslam.cells.pose_3d import Pose3DConfig
from neuroslam.cells.speed import SpeedCellConfig
from neuroslam.config import BrainConfig, Section
from neuroslam.config.clones import CloneConfig
from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.ros.settings import RosSettings
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.worlds.landmarks import LandmarkView

ROOT = Path(neuroslam.__file__).parent


def sections(section):
    """The section, and all within it."""
    found = {section}
    for field in section.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            found |= sections(field.annotation)
    return found


ALL = {
    each
    for section in (
        BrainConfig,
        SSPSLAMConfig,
        HeadDirectionConfig,
        SpeedCellConfig,
        Pose3DConfig,
        CloneConfig,
        RosSettings,
    )
    for each in sections(section)
}
NAMES = {"c", "cells", "config", "settings"} | {
    name
    for section in ALL
    for name, field in section.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, Section)
}
"""What variables with a section are called in the package."""


def names_read(tree):
    """Names read of a section: ``config.name``, or of a list given to ``getattr``."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            of = node.value
            if (of.attr if isinstance(of, ast.Attribute) else getattr(of, "id", "")) in NAMES:
                found.add(node.attr)
        elif isinstance(node, ast.FunctionDef):
            parts = list(ast.walk(node))
            if any(isinstance(part, ast.Name) and part.id == "getattr" for part in parts):
                found |= {p.value for p in parts if isinstance(p, ast.Constant)}
    return found


@cache
def read_anywhere():
    files = (p for p in ROOT.rglob("*.py") if p.relative_to(ROOT).parts[0] != "config")
    return set().union(*(names_read(ast.parse(p.read_text(encoding="utf-8"))) for p in files))


def test_the_package_s_own_sections_are_all_known():
    def below(section):
        return {section}.union(*map(below, section.__subclasses__()))

    own = {s for s in below(Section) - {Section} if s.__module__.startswith("neuroslam.")}
    assert own <= ALL


def read_by_itself(section):
    """Keys that the methods of a section read which is no part of a brain's config."""
    if section.__module__.startswith("neuroslam.config."):
        return set()
    tree = ast.parse(inspect.getsource(section))
    return {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and name_of(n) == "self"}


def name_of(attribute):
    return getattr(attribute.value, "id", "")


@pytest.mark.parametrize("section", sorted(ALL, key=lambda s: s.__name__))
def test_code_outside_of_the_config_reads_every_key(section):
    assert not section.model_fields.keys() - read_anywhere() - read_by_itself(section)


def test_a_key_that_a_call_sets_is_not_read_by_it():
    assert not names_read(ast.parse("PathIntegratorConfig(velocity_neurons=500)"))
    assert not names_read(ast.parse("config.velocity_neurons = 500"))
    assert names_read(ast.parse("n = self.config.velocity_neurons")) == {"velocity_neurons"}
    loop = "def f(config):\n    return [getattr(config, name) for name in ('n', 'seed')]"
    assert names_read(ast.parse(loop)) == {"n", "seed"}


MINE = {
    "algebraic": {"tier": "algebraic", "time_step_s": 0.01},
    "random": {"tier": "algebraic", "space": {"kind": "random", "n_random": 6}},
    "spiking": {
        "integrator": {"neurons": 10, "velocity_neurons": 10},
        "map": {"neurons": 12, "relay": True},
        "binding_neurons": 4,
        "vector_neurons": 12,
        "grid_neurons": 12,
        "places": True,
    },
    "quantised": {"quantised": True, "integrator": {"neurons": 10}, "map": {"neurons": 12}},
}


def test_ssp_slam_reads_each_of_its_keys_when_it_is_made_or_stepped(monkeypatch):
    monkeypatch.setattr(switch, "ENABLED", False)
    taken = set()

    def noted(section, name):
        if not name.startswith("_") and name in type(section).__pydantic_fields__:
            taken.add((type(section), name))
        return object.__getattribute__(section, name)

    small = {"n_rotations": 1, "n_scales": 2}
    configs = [SSPSLAMConfig(**{"space": small} | each) for each in MINE.values()]
    monkeypatch.setattr(Section, "__getattribute__", noted, raising=False)
    for config in configs:
        n_features = 2 * 6 + 1
        slam = SSPSLAM(config, torch.eye(2, n_features))
        at = torch.zeros(2, 1, 2, 2).numpy()
        view = LandmarkView(at[..., 0] == 0, at[..., 0], at, at, torch.arange(2).numpy())
        slam.run(torch.zeros(2, 1, 2), view)
    monkeypatch.undo()
    wanted = {(section, k) for section in sections(SSPSLAMConfig) for k in section.model_fields}
    missing = sorted(f"{s.__name__}.{k}" for s, k in wanted - taken)
    assert not missing
