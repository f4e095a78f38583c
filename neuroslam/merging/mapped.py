"""The interface of a brain for matching and merging, and the check of two configs."""

from typing import Any, Protocol

from torch import Tensor

from neuroslam.config import BrainConfig
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.state import answers
from neuroslam.state.mergeable import Mergeable
from neuroslam.state.population import Population
from neuroslam.state.registry import population_classes
from neuroslam.state.sessions import SessionLog
from neuroslam.view.templates import LocalViewCells


class Mapped(Protocol):
    """The parts of a brain that matching and merging use."""

    config: BrainConfig
    map: ExperienceMap
    view: LocalViewCells
    sessions: SessionLog

    @property
    def leader(self) -> Population:
        """The population that decides about experiences."""
        ...

    @property
    def populations(self) -> dict[str, Population]:
        """All populations by kind."""
        ...

    def parts(self) -> dict[str, Mergeable]:
        """The parts of the state by name."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """The whole state."""
        ...


SAME_CONFIG = "run the second session with --config FIRST/config.toml, the config of the first"
"""Remedy for maps whose configs differ."""


def differing_keys(one: BrainConfig, other: BrainConfig) -> list[str]:
    """Name the parameters of views and populations that differ, which prevents a merge.

    The path of network weights is ignored; :func:`differing` compares the weights themselves. The
    threshold is ignored where sequences of views close loops: it decides nothing there.

    Example:
        >>> differing_keys(BrainConfig(), BrainConfig(view={"threshold": 0.04}))
        ['view.threshold is 0.05 and 0.04']
    """
    if one.cells != other.cells:
        return [f"cells is {'+'.join(one.cells)} and {'+'.join(other.cells)}"]
    sections = ["view", "pose_cells"]
    for population in population_classes(one):
        own = (population.kind,) if population.config_section else ()
        sections += [s for s in (*population.merge_sections, *own) if s not in sections]
    ignored = {("view", "weights")}
    if one.map.closure == other.map.closure == "sequence":
        ignored.add(("view", "threshold"))
    differing = []
    for section in sections:
        first, second = (getattr(config, section).model_dump() for config in (one, other))
        differing += [
            f"{section}.{key} is {first[key]} and {second[key]}"
            for key in first
            if first[key] != second[key] and (section, key) not in ignored
        ]
    return differing


def differing(one: Mapped, other: Mapped) -> list[str]:
    """Name the parameters or the network weights that prevent a merge of two brains."""
    keys = differing_keys(one.config, other.config)
    networks = {brain.view.network_digest for brain in (one, other)} - {0}
    if not keys and len(networks) > 1:
        keys = [f"the weights of the network of views, {one.config.view.features!r}, differ"]
    return keys


def counts_of(brain: Mapped) -> dict[str, float]:
    """Count the templates, experiences and links of a brain, and the counts of its populations."""
    counts: dict[str, Any] = {
        "views": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
    }
    return counts | answers.gathered(brain.populations.values(), answers.counts_of)
