"""The folders are the data flow: an import never points against it, and none goes in a circle."""

import ast
import importlib
import inspect
import pkgutil
import textwrap
from pathlib import Path

import networkx as nx
import pytest
from torch import nn

import neuroslam
from neuroslam.cells import GridSheet
from neuroslam.state.tables import Scalars

ROOT = Path(__file__).resolve().parents[1] / "neuroslam"

PLAN = [line.split() for line in """
    types errors geometry compiled threads interrupts limits workers
    config
    state
    sensors worlds
    odometry view cells spiking mapping
    merging
    brain
    shared_map
    evaluation
    figures
    adapters
    runs report tuning experiments
    ros
    cli
    __main__
""".strip().splitlines()]  # fmt: skip
"""The layers: a file imports from its own and from those above it, also where it is lazy."""

LEVEL = {room: level for level, rooms in enumerate(PLAN) for room in rooms}

MODULES = {
    ".".join(("neuroslam", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in sorted(ROOT.rglob("*.py"))
}
FRONT_DOOR = "neuroslam"  # its names are imported when they are first used


def imports(path: Path) -> set[str]:
    """Every module of the package that a file imports, also in functions and for type checks."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports name the whole path"
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                found.add(inside if inside in MODULES else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & MODULES.keys()


def room_of(module: str) -> str:
    return module.split(".")[1]


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {FRONT_DOOR}))
def test_imports_follow_the_plan(module):
    for used in imports(MODULES[module]) - {FRONT_DOOR}:
        allowed = LEVEL[room_of(used)] <= LEVEL[room_of(module)]
        assert allowed, f"{module} must not import {used}: the plan has it below"


def test_no_two_files_import_each_other_in_a_circle():
    graph = nx.DiGraph()
    for module in MODULES.keys() - {FRONT_DOOR}:
        graph.add_edges_from((module, used) for used in imports(MODULES[module]))
    circles = [sorted(c) for c in nx.strongly_connected_components(graph) if len(c) > 1]
    assert not circles


def test_every_file_is_in_a_room_of_the_plan_and_no_room_has_a_second_floor():
    for module, path in MODULES.items():
        inside = path.relative_to(ROOT).parts
        assert module == FRONT_DOOR or room_of(module) in LEVEL, module
        alone = {"__init__.py", "__main__.py", *(f"{name}.py" for name in PLAN[0])}
        assert len(inside) == 2 or inside[0] in alone, module
        assert len(inside) <= 2, module


def test_the_tests_mirror_the_rooms():
    folders = {p.parent.name for p in Path(__file__).parent.rglob("test_*.py")} - {"tests"}
    assert folders - {"docs", "typing"} <= LEVEL.keys()  # those two are of no room


def test_torchvision_is_imported_through_one_door():
    for path in ROOT.rglob("*.py"):
        if path.relative_to(ROOT) != Path("view/vision.py"):
            text = path.read_text()
            assert "import torchvision" not in text, path
            assert "from torchvision" not in text, path


def our_modules() -> list[type[nn.Module]]:
    """Every class of the package that is an nn.Module."""
    found = set()
    for info in pkgutil.walk_packages(neuroslam.__path__, "neuroslam."):
        for value in vars(importlib.import_module(info.name)).values():
            if inspect.isclass(value) and issubclass(value, nn.Module):
                found.add(value)
    return sorted((c for c in found if c.__module__.startswith("neuroslam.")), key=str)


MEANT_TO_BE_OVERRIDDEN = {"forward", "extra_repr"}


def names_of(module: type[nn.Module]) -> set[str]:
    """Names that a class defines: methods, annotated fields, what is assigned to self."""
    names = {*vars(module), *vars(module).get("__annotations__", {})}
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(module)))):
        stored = isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
        if stored and isinstance(node.value, ast.Name) and node.value.id == "self":
            names.add(node.attr)
    return names


@pytest.mark.parametrize("module", our_modules(), ids=lambda c: c.__name__)
def test_no_module_hides_a_name_of_torch(module):
    of_torch = {name for name in {*dir(nn.Module), *vars(nn.Module())} if not name.startswith("_")}
    hidden = names_of(module) & of_torch - MEANT_TO_BE_OVERRIDDEN
    assert not hidden


@pytest.mark.parametrize("name", ["parameters", "half", "training"])
def test_a_number_of_the_state_hides_no_name_of_torch(name):
    with pytest.raises(ValueError, match=f"'{name}' is a name of nn.Module"):
        Scalars(**{name: 1})


def test_the_parameters_of_every_module_can_be_listed():
    sheet = GridSheet(n_cells=2)
    assert list(sheet.parameters()) == []
    sheet.float().requires_grad_(False).zero_grad()
    assert {"GridSheet", "NavigationBrain", "SSPSLAM"} <= {c.__name__ for c in our_modules()}
