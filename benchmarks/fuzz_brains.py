"""Brains that were crafted: every tensor and every parameter changed in turn, the digest valid."""

import json
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open

from neuroslam.cli import main
from neuroslam.state.files import save_checked

CRAFTED = 216
"""Crafted brains of a campaign."""
STOP, LATER = 20, 24
SOURCE = "world:corridor?width=64&height=40&frames_per_lap=60&landmark_reach=8&odometry=true"
CELLS = "pose+semantic+head_direction+speed"
_KEY = "neuroslam"
_CONFIG = {
    "view.template_width": (10**9, 30, -1, "x"),
    "view.template_height": (4000, 0, None),
    "pose_cells.n_xy": (10**6, 1000, 22, 0),
    "pose_cells.n_theta": (1023, 9),
    "semantic.space.n_scales": (64, 2, 10**12),
    "semantic.time_step_s": (1e-12, 0.0, 1e308),
    "head_direction.n": (1000, 24),
    "speed.n": (20_000, 2),
    "threads": (10**6, 200),
    "map.loops": (10**9, 0),
    "cells": (["pose"], [], ["nobody"], "pose"),
    "sessions.confirm": (10**18, 1),
}


def sound_run(out: Path) -> Path:
    """Make a run of a rendered world with three kinds of cells, and a second one beside it."""
    for folder, seed in ((out, 0), (out.with_name(f"{out.name}_other"), 1)):
        if not folder.is_dir():
            words = ["run", f"{SOURCE}&seed={seed}", "-o", str(folder), "--stop", str(STOP)]
            code = main([*words, "--set", f"cells={CELLS}", "--set", "semantic.space.n_scales=3"])
            assert code == 0, "the sound run failed"
    return out


def commands_of(out: Path) -> list[tuple[str, ...]]:
    """Return the commands that take a crafted run; ``@`` stands for its folder."""
    other = str(out.with_name(f"{out.name}_other"))
    return [
        ("inspect", "@"),
        ("export", "@", "@/map.g2o"),
        ("report", "@", "--pictures", "0"),
        ("merge", other, "@", "-o", "@/merged", "--overwrite"),
        (
            "run",
            SOURCE,
            "-o",
            "@/joined",
            "--map",
            "@/brain.safetensors",
            "--stop",
            "3",
            "--no-tensorboard",
            "--overwrite",
        ),
        ("resume", "@", "--stop", str(LATER), "--no-tensorboard"),
    ]


def crafted(folder: Path, number: int) -> str:
    """Change the brain of a run in one place; return what was changed."""
    file = folder / "brain.safetensors"
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()[_KEY])
        tensors = {name: opened.get_tensor(name) for name in sorted(opened.keys())}
    draw = np.random.default_rng(1000 + number)
    if number % 6 == 5:
        keys = sorted(_CONFIG)
        key = keys[int(draw.integers(len(keys)))]
        value = _CONFIG[key][int(draw.integers(len(_CONFIG[key])))]
        where = about["config"]
        *path, last = key.split(".")
        for part in path:
            where = where[part]
        where[last] = value
        what = f"{key}={value}"
    else:
        names = [name for name in tensors if tensors[name].numel() or number % 7 == 0]
        name = names[int(draw.integers(len(names)))]
        how = str(draw.choice(list(_CHANGES)))
        tensors[name] = _CHANGES[how](tensors[name].clone(), draw).contiguous()
        what = f"{name}: {how}"
    rest = {key: value for key, value in about.items() if key != "sha256"}
    save_checked(file, rest, tensors)  # a valid digest
    (folder / "manifest.json").unlink(missing_ok=True)  # else it differs from what was saved
    return what


def _number(t: torch.Tensor, value: float, draw: np.random.Generator) -> torch.Tensor:
    flat = t.reshape(-1)
    if len(flat):
        at = int(draw.integers(len(flat)))
        if t.dtype.is_floating_point or np.isfinite(value):
            info = (
                None if t.dtype.is_floating_point or t.dtype == torch.bool else torch.iinfo(t.dtype)
            )
            flat[at] = value if info is None else int(min(max(value, info.min), info.max))
    return flat.reshape(t.shape)


_CHANGES = {
    "nan": lambda t, d: _number(t, np.nan, d),
    "inf": lambda t, d: _number(t, np.inf, d),
    "-1": lambda t, d: _number(t, -1, d),
    "large": lambda t, d: _number(t, 10.0**9, d),
    "largest": lambda t, d: _number(t, 2.0**62, d),
    "all zero": lambda t, _d: torch.zeros_like(t),
    "a row less": lambda t, _d: t[:-1] if t.dim() else t.reshape(1),
    "a row more": lambda t, _d: torch.cat([t, t[-1:]]) if t.dim() else t.reshape(1, 1),
    "empty": lambda t, _d: t[:0] if t.dim() else t.reshape(1)[:0],
    "another type": lambda t, _d: t.to(torch.float16 if t.dtype.is_floating_point else torch.int16),
    "another shape": lambda t, _d: t.reshape(*t.shape, 1),
}
