"""The pairs of maps by which merging is measured: what they are, not how they fare."""

import math

import numpy as np
import pytest

from neuroslam.experiments import merging_pairs as pairs
from neuroslam.types import Pose
from neuroslam.worlds.world import Camera, render


def test_the_sets_share_no_drive_and_each_is_the_same_every_time():
    drives = {half: [repr(drive) for drive in pairs.drives(half)] for half in pairs.HALVES}
    everything = [drive for of_half in drives.values() for drive in of_half]
    assert len(set(everything)) == len(everything)
    assert [repr(drive) for drive in pairs.drives("held-out")] == drives["held-out"]
    assert sum(pairs.N_TRUE.values()) == 100
    assert sum(pairs.N_FALSE.values()) == 300


def test_buildings_with_one_wallpaper_look_alike_from_the_same_distance_to_a_corner():
    views = []
    for number in (1, 2):
        world = pairs.wallpapered(number, straight=False)
        x, y = world.walls[:4, 0].max() - 0.9, world.walls[:4, 1].max()  # the aisle at the right
        pose = Pose(float(x), float(y - 4.0), math.pi / 2.0)
        views.append(render(world, pose, Camera(80, 40), [], 1.0).astype(int))
    assert not np.array_equal(world.walls, pairs.wallpapered(1, straight=False).walls)
    assert np.abs(views[0] - views[1]).mean() / 255.0 < 0.06


@pytest.mark.parametrize(("from_lap", "common"), [(0.0, 0.5), (0.25, 0.25), (0.6, 0.1)])
def test_the_overlap_is_the_common_path_in_laps(from_lap, common):
    def drive(first):
        lap = 2.0 * math.pi * np.arange(first, first + 0.5, 0.01)
        circle = np.column_stack([np.cos(lap), np.sin(lap), lap + math.pi / 2.0])
        plan = pairs.Drive("track", "circle", "", (0, 50), {})
        return pairs.Driven(plan, None, circle, 2.0 * math.pi, True)

    found = pairs.overlap(drive(0.0), drive(from_lap))
    assert found == pytest.approx(common, abs=2.0 * pairs.SAME_PLACE)
