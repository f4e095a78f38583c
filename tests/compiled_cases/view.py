"""Views and visual odometry."""

import numpy as np

from neuroslam.config import OdometryConfig, ViewConfig
from neuroslam.odometry import VisualOdometry
from neuroslam.odometry.visual import match_profiles
from neuroslam.sensors.grey import to_grey
from neuroslam.view import LocalViewCells
from neuroslam.view.preprocess import encode
from neuroslam.view.search import Geometry, distances
from neuroslam.view.sequence import SequenceMatcher
from tests.compiled_cases import case, with_and_without


def random_images(rng, n=2):
    """Grey images of one random size: a texture, each noisier than the one before."""
    height, width = rng.integers(40, 90, 2)
    texture = rng.integers(0, 256, (height, width), np.uint8)
    noise = rng.integers(-9, 10, (n, height, width)) * np.arange(n)[:, None, None]
    return np.clip(texture.astype(int) + noise, 0, 255).astype(np.uint8)


def random_view_config(rng):
    return ViewConfig(
        template_width=int(rng.integers(12, 32)),
        template_height=int(rng.integers(3, 12)),
        shift_match=int(rng.integers(0, 4)),
        shift_step=int(rng.integers(1, 3)),
        panoramic=bool(rng.integers(2)),
        precision=("uint8", "float64")[rng.integers(2)],
        mean_gate=bool(rng.integers(2)),
        threshold=float(rng.uniform(0.02, 0.2)),
        normalisation=(0.0, 0.5)[rng.integers(2)],
        patch_radius=int(rng.integers(0, 4)),
    )


@case("sensors.grey.mean_step")
def _mean_of_colours(rng):
    image = rng.integers(0, 256, (*rng.integers(1, 40, 2), 3), np.uint8)
    return with_and_without(lambda: [to_grey(image, "mean")])


@case("view.preprocess.encode_step")
def _encode(rng):
    (image,), config = random_images(rng, 1), random_view_config(rng)
    return with_and_without(lambda: encode(image[:, 1:], config))


@case("view.search.nearest_step", "view.search.learn_step", "view.search.coarse_step")
def _views(rng):
    config = random_view_config(rng)
    size = (int(rng.integers(0, 70)), config.template_height, config.template_width)
    templates = rng.random(size) * rng.uniform(0.5, 1.0, (size[0], 1, 1))
    views = rng.random((5, *size[1:]))
    if size[0]:
        views[1:] = np.roll(templates[rng.integers(size[0], size=4)], 1, axis=2)
        views[1:] += rng.uniform(-0.02, 0.02, views[1:].shape)  # or two shifts may be equally near
        views = np.clip(views, 0.0, 1.0)
        templates[-1] = templates[0]

    def call():
        cells = LocalViewCells(config)
        for template in templates:
            cells.learn(template)
        cells.last.template = 3
        found = [tuple(cells.search(view)) for view in views]
        return [found, *(cells.templates[name].numpy() for name in cells.templates.columns)]

    return with_and_without(call)


@case("view.search.distances_step")
def _distances(rng):
    geometry = Geometry.of(random_view_config(rng))
    pixels = rng.integers(0, 256, (7, geometry.width * geometry.height), np.uint8)
    query = rng.integers(0, 256, (geometry.width, geometry.height), np.uint8)
    return with_and_without(lambda: [distances(pixels, query, geometry)])


@case("odometry.visual.match_step")
def _match(rng):
    n = int(rng.integers(5, 40))
    now, previous = rng.integers(0, rng.integers(2, 1000), (2, n)).astype(np.int32)
    return with_and_without(lambda: match_profiles(now, previous, n // 2))


@case("odometry.visual.measure_step")
def _measure(rng):
    images, first_frame = random_images(rng, 4), ("still", "zero_profile")[rng.integers(2)]
    config = OdometryConfig(max_shift_px=9, first_frame=first_frame)

    def call():
        odometry = VisualOdometry(config)
        motions = [odometry(image, 0.1) for image in images]
        return [motions, odometry.speed_sums.numpy(), odometry.turn_sums.numpy()]

    return with_and_without(call)


@case("view.sequence.sequence_step")
def _sequence(rng):
    ratios = tuple(rng.uniform(-1.5, 2.0, rng.integers(1, 5)))
    sizes = np.sort(rng.integers(1, 30, 8))
    rows = [np.where(rng.random(n) < 0.1, np.nan, rng.random(n)) for n in sizes]
    length = int(rng.integers(1, 6))

    def call():
        matcher = SequenceMatcher(length, ratios)
        found = [matcher.scores(row) for row in rows] + [matcher.recent["errors"].numpy().copy()]
        return [np.nan_to_num(array, nan=9.0, posinf=99.0) for array in found]

    return with_and_without(call)
