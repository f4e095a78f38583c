"""What a population answers when it is asked, checked: numbers, pictures and tables.

Runs, reports and TensorBoard ask through these functions, so that a population of a user's may
answer by NumPy's or torch's numbers, and a wrong answer is told by the name of who gave it.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import TypeVar

import numpy as np
from torch import Tensor

from neuroslam.errors import ConfigError
from neuroslam.state.population import Correction, Picture, Population

Answer = TypeVar("Answer")

RUN_TABLES = ("frames.csv", "experiences.csv", "links.csv")
"""Tables that every run writes: a population's must be called otherwise."""

RUN_FIGURES = (
    "frames", "seconds", "cpu_seconds", "frames_per_s", "frames_per_cpu_s", "templates",
    "views", "experiences", "links", "loop_closures", "merges", "merge_reports", "refused_merges",
    "not_joined", "frames_on_no_joined_map", "skipped_frames", "skipped", "unused", "notes",
    "measured_motion", "warnings", "pictures", "tables", "interrupted",
    "ate_rmse_m", "odometry_ate_rmse_m", "ate_similarity_rmse_m", "frames_with_truth",
)  # fmt: skip
"""Figures that every run has: a population's counts must be called otherwise."""

RUN_TAGS = (
    "view/templates", "view/match_error", "view/frame_and_template", "map/experiences", "map/links",
    "map/largest_correction", "map/experiences_and_links", "run/frames_per_s", "cells/place_map",
    "cells/boundary_response", "cells/grid_rate_maps", "cells/boundary_cells", "cells/place_bump",
)  # fmt: skip
"""Tags of TensorBoard that a run writes itself: a population's must be called otherwise."""


def counts_of(population: Population) -> dict[str, float]:
    """Return what a population has learnt, as plain numbers by name.

    Raises:
        TypeError: If it is anything else, or a name is one of :data:`RUN_FIGURES`.
    """
    counts = _numbers(population, "counts", population.counts())
    for name in counts.keys() & set(RUN_FIGURES):
        raise TypeError(f"{_who(population)}.counts(): {name!r} is a figure of every run; rename")
    return counts


def scalars_of(population: Population) -> dict[str, float]:
    """Return a population's curves now, as plain numbers by tag.

    Raises:
        TypeError: If it is anything else, or a tag is one of :data:`RUN_TAGS`.
    """
    scalars = _numbers(population, "scalars", population.scalars())
    _refuse_tags(population, "scalars", scalars)
    return scalars


def pictures_of(population: Population) -> dict[str, Picture]:
    """Return a population's pictures as arrays by tag; those that have no pixel are left out.

    Raises:
        TypeError: If one is no array, ``(h, w)`` or ``(h, w, 3)``, nor a tuple of the former; or a
            tag is one of :data:`RUN_TAGS`.
    """
    pictures: dict[str, Picture] = {}
    for tag, picture in _named(population, "images", population.images()).items():
        layered = isinstance(picture, tuple | list)
        parts = picture if isinstance(picture, tuple | list) else (picture,)
        layers = tuple(_array(layer) for layer in parts)
        coloured = [layer.dtype == np.uint8 and layer.shape[2:] == (3,) for layer in layers]
        if any(layer.ndim != 2 and (layered or not rgb)
               for layer, rgb in zip(layers, coloured, strict=True)):  # fmt: skip
            shapes = ", ".join(f"{layer.dtype} {layer.shape}" for layer in layers)
            raise TypeError(
                f"{_who(population)}.images(): {tag!r} is {shapes}; expected an array (h, w), a "
                "tuple of such, or uint8 (h, w, 3)"
            )
        if layers and all(layer.size for layer in layers):
            pictures[tag] = layers if layered else layers[0]
    _refuse_tags(population, "images", pictures)
    return pictures


def tables_of(population: Population) -> dict[str, str]:
    """Return a population's CSV tables by the name of the file.

    Raises:
        TypeError: If a table is no text that begins with its columns, or its name is no plain
            file name that ends in ``.csv``, or one of :data:`RUN_TABLES`.
    """
    tables: dict[str, str] = {}
    for name, text in _named(population, "tables", population.tables()).items():
        if not re.fullmatch(r"[\w-]+\.csv", name) or name.lower() in RUN_TABLES:
            raise TypeError(
                f"{_who(population)}.tables(): {name!r} is not a name for it; expected one like "
                f"{population.kind}.csv"
            )
        if not isinstance(text, str) or not text.partition("\n")[0].strip():
            raise TypeError(
                f"{_who(population)}.tables(): {name!r} is {text!r:.40}; expected text whose first "
                "line has the columns"
            )
        tables[name] = text
    return tables


def gathered(
    populations: Iterable[Population], ask: Callable[[Population], Mapping[str, Answer]]
) -> dict[str, Answer]:
    """Return what all populations of a brain answer, by name.

    Args:
        populations: The populations.
        ask: One of :func:`counts_of`, :func:`scalars_of`, :func:`pictures_of`, :func:`tables_of`.

    Raises:
        TypeError: If one answers what it must not, or two use the same name.

    Example:
        >>> from neuroslam.config.populations import population_class
        >>> from neuroslam.config import BrainConfig
        >>> pose = population_class("pose")
        >>> cells = pose.build(BrainConfig(), pose)
        >>> list(gathered([cells], scalars_of))
        ['cells/peak']
        >>> gathered([cells, cells], scalars_of)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        TypeError: PoseCellNetwork and PoseCellNetwork: both name one of their scalars() ...
    """
    answers: dict[str, Answer] = {}
    first: dict[str, Population] = {}
    for population in populations:
        for name, answer in ask(population).items():
            key = name.lower() if ask is tables_of else name  # files on any disk
            if key in first:
                raise TypeError(
                    f"{_who(first[key])} and {_who(population)}: both name one of their "
                    f"{HOOKS[ask]}() {name!r}; rename one"
                )
            first[key], answers[name] = population, answer
    return answers


def check_names(populations: Iterable[Population]) -> None:
    """Refuse populations that use the same name for a count, scalar, image or table.

    Raises:
        ConfigError: If two do.
    """
    together = list(populations)
    for ask in HOOKS:
        try:
            gathered(together, ask)
        except TypeError as error:
            raise ConfigError(
                f"cells = {'+'.join(one.kind for one in together)}: {error}"
            ) from error


HOOKS: dict[Callable[[Population], Mapping[str, object]], str] = {
    counts_of: "counts",
    scalars_of: "scalars",
    pictures_of: "images",
    tables_of: "tables",
}
"""The functions of this module that ask a population, and the method that each asks."""


def moves_others(population: Population | None, correction: Correction | None) -> bool:
    """Tell whether others have to follow what ``step`` or ``recall`` has returned.

    Raises:
        TypeError: If that is neither a correction nor ``None``.
    """
    if correction is None:
        return False
    if not isinstance(correction, Correction):
        raise TypeError(
            f"{type(population).__name__}: step() or recall() returned "
            f"{type(correction).__name__}, expected a Correction or None"
        )
    return not correction.is_nothing


def _numbers(population: Population, hook: str, answer: object) -> dict[str, float]:
    plain: dict[str, float] = {}
    for name, value in _named(population, hook, answer).items():
        if isinstance(value, Tensor | np.ndarray | np.generic) and np.prod(value.shape) == 1:
            value = value.item()
        if not isinstance(value, Real):
            raise TypeError(
                f"{_who(population)}.{hook}(): {name!r} is {type(value).__name__}, expected a "
                "number"
            )
        plain[name] = int(value) if isinstance(value, bool | int) else float(value)
    return plain


def _refuse_tags(population: Population, hook: str, tags: Iterable[str]) -> None:
    for tag in tags:
        if tag in RUN_TAGS or tag.startswith(("ssp/", "ssp_rate_hz/")):
            raise TypeError(f"{_who(population)}.{hook}(): {tag!r} is a tag of every run; rename")


def _named(population: Population, hook: str, answer: object) -> Mapping[str, object]:
    if not isinstance(answer, Mapping) or not all(isinstance(name, str) for name in answer):
        raise TypeError(
            f"{_who(population)}.{hook}(): returned {type(answer).__name__}, expected a dict by "
            "name"
        )
    return answer


def _array(picture: object) -> np.ndarray:
    return picture.numpy(force=True) if isinstance(picture, Tensor) else np.asarray(picture)


def _who(population: Population) -> str:
    return type(population).__name__
