"""The folders are the data flow: an import never points against it, and none goes in a circle."""

import ast
from pathlib import Path

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[1] / "neuroslam"

PLAN = [line.split() for line in """
    types errors geometry
    config
    state
    sensors worlds
    odometry view cells spiking mapping
    merging
    brain
    evaluation
    figures
    runs report tuning experiments
    cli
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
    # Taken out of the circle when the brain is made anew: brain, merge and the three matchings.
    circles = [c for c in circles if {room_of(module) for module in c} != {"brain"}]
    assert not circles


def test_every_file_is_in_a_room_of_the_plan_and_no_room_has_a_second_floor():
    for module, path in MODULES.items():
        inside = path.relative_to(ROOT).parts
        assert module == FRONT_DOOR or room_of(module) in LEVEL, module
        assert len(inside) == 2 or inside[0] in ("__init__.py", "types.py", "errors.py",
                                                 "geometry.py"), module  # fmt: skip
        assert len(inside) <= 2, module


def test_the_tests_mirror_the_rooms():
    folders = {p.parent.name for p in Path(__file__).parent.rglob("test_*.py")} - {"tests"}
    assert folders <= LEVEL.keys()


def test_torchvision_is_imported_through_one_door():
    for path in ROOT.rglob("*.py"):
        if path.relative_to(ROOT) != Path("view/vision.py"):
            text = path.read_text()
            assert "import torchvision" not in text, path
            assert "from torchvision" not in text, path
