"""The folders are the data flow: an import never points against it."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / "neuroslam"

FLOW = [
    "errors", "types", "geometry", "sections", "semantic_sections", "config",
    "storage", "checked_files", "population", "vision", "parallel",
    "sensors", "odometry", "view", "cells", "spiking", "mapping", "brain",
    "evaluation", "drawing", "plotting", "cell_drawing", "heading_drawing", "place_drawing",
    "spike_drawing", "semantic_drawing", "cell_panels", "semantic_panels",
    "merge_drawing", "comparison_drawing", "sweep_drawing", "recording", "run_files",
    "inspection", "export",
    "review", "report", "runs", "tuning", "merging", "sweeps", "fleets", "demo",
    "experiments", "cli",
]  # fmt: skip
SIDE_BY_SIDE = {("odometry", "view"), ("view", "odometry")}


def layer_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_follow_the_data_flow(path):
    layer = layer_of(path)
    if layer == "__init__":
        return  # the front door opens onto every room
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the whole path"
            inside = node.module == "neuroslam"
            names = [f"neuroslam.{a.name}" for a in node.names] if inside else [node.module]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            package, _, rest = name.partition(".")
            if package != "neuroslam":
                continue
            used = rest.partition(".")[0]
            assert used in FLOW[: FLOW.index(layer) + 1], f"{layer} must not import {name}"
            assert (layer, used) not in SIDE_BY_SIDE, f"{layer} and {used} do not know each other"


def test_every_room_is_in_the_plan():
    rooms = {layer_of(p) for p in ROOT.rglob("*.py")} - {"__init__"}
    assert rooms <= set(FLOW)
    assert all(len(p.relative_to(ROOT).parts) <= 2 for p in ROOT.rglob("*.py"))


def test_torchvision_is_imported_through_one_door():
    for path in ROOT.rglob("*.py"):
        if path.name != "vision.py":
            text = path.read_text()
            assert "import torchvision" not in text, path
            assert "from torchvision" not in text, path
