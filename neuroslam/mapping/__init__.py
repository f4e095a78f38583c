"""The experience map: a graph of experiences, its solvers, and paths through it."""

from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.planning import Plan, quickest_path
from neuroslam.mapping.tables import Links

__all__ = ["ExperienceMap", "Links", "Plan", "quickest_path"]
