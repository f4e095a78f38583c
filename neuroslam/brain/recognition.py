"""Recognition of stored maps: view matches, and their agreement on the alignment of the maps."""

from collections.abc import Sequence

import numpy as np
import torch

from neuroslam.brain.stored_sequence import StoredGraph, StoredSequence
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import Tolerance, agreeing, n_places
from neuroslam.state.join import Join
from neuroslam.state.match import Pairs
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE, ViewMatch
from neuroslam.view.templates import LocalViewCells


class StoredViews:
    """The templates of several maps as one memory, searched in one pass.

    Args:
        views: Templates of at least one map, all with equal configs.
        maps: The maps.

    Attributes:
        graph: Their experiences and links.
    """

    def __init__(self, views: Sequence[LocalViewCells], maps: Sequence[ExperienceMap]) -> None:
        self.graph = StoredGraph(maps, [one.n for one in views])
        self.joined = LocalViewCells(views[0].config)
        self.joined.templates.replace(
            **{
                name: torch.cat([one.templates[name] for one in views])
                for name in self.joined.templates.columns
            }
        )
        self.starts = np.cumsum([0, *(one.n for one in views)])

    def search(self, view: np.ndarray) -> tuple[int, ViewMatch]:
        """Return the map of the nearest template of all maps, and the match.

        The template has its number in that map; ``NO_TEMPLATE`` if none is within the threshold.
        """
        threshold = self.joined.config.threshold
        match = self.joined.search(view, threshold)
        if match.template == NO_TEMPLATE or match.error > threshold:
            return -1, match._replace(template=NO_TEMPLATE)
        self.joined.last.template = match.template  # the next match is likely next to it
        where = int(np.searchsorted(self.starts, match.template, side="right")) - 1
        return where, match._replace(template=match.template - int(self.starts[where]))

    def compare(self, view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return match error and relative heading of a view with every experience of all maps."""
        errors, headings = self.joined.compare(view)
        return np.append(errors, 1.0)[self.graph.template], np.append(headings, 0.0)[
            self.graph.template
        ]

    def runner_up(self, view: np.ndarray, where: int, near: np.ndarray) -> float | None:
        """Return the smallest match error with templates except ``near`` of map ``where``."""
        rest = np.setdiff1d(np.arange(self.joined.n), self.starts[where] + near)
        return min(self.joined.differences(view, rest), default=None)


class Arrivals(Scalars):
    """How often the robot has come to a place."""

    arrivals: int


class Recognition(Mergeable):
    """Recent view matches with stored maps: the evidence for joining one.

    Attributes:
        sequence: Evidence of sequences of views; ``None`` where single views decide.
    """

    def __init__(self) -> None:
        super().__init__()
        self.sequence: StoredSequence | None = None
        self.state = Arrivals(arrivals=0)
        integers = ("arrival", "map", "loaded", "partial")
        self.sightings = GrowingTable(
            {name: ((), torch.int64) for name in integers}
            | {name: ((), torch.float64) for name in ("turn_rad", "error")}
        )
        # For each stored map: number of matched experiences, and the most that agreed.
        self.tally = GrowingTable({"alike": ((), torch.int64), "agreed": ((), torch.int64)})

    def renumber(self, change: Renumbering) -> None:
        """Follow the ids of the present map."""
        partial = self.sightings.array("partial")
        partial[:] = change.experiences[partial]

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Drop all matches and the evidence of sequences: the ids have changed."""
        own = {name: v for name, v in partial.items() if not name.startswith("sequence.")}
        merged = {name: v if name.startswith("state.") else v[:0] for name, v in own.items()}
        if self.sequence is not None:
            fresh = StoredSequence(self.sequence.config).state_dict()
            merged |= {f"sequence.{name}": value for name, value in fresh.items()}
        return merged

    def arrive(self, window: int) -> None:
        """Count an arrival at an experience; drop matches more than ``window`` arrivals ago."""
        self.state.arrivals += 1
        recent = self.sightings["arrival"] > self.state.arrivals - window
        if not recent.all():
            columns = {name: self.sightings[name][recent] for name in self.sightings.columns}
            self.sightings.replace(**columns)

    def note(
        self, where: int, loaded: np.ndarray, partial: int, turn_rad: float, error: float
    ) -> None:
        """Store the view match of an experience with experiences of a stored map."""
        for experience in loaded.tolist():
            self.sightings.append(
                arrival=self.state.arrivals, map=where, loaded=experience, partial=partial,
                turn_rad=turn_rad, error=error,
            )  # fmt: skip
        self.tally["alike"][where] += 1

    def confirmed(
        self, where: int, loaded: ExperienceMap, partial: ExperienceMap, limits: Tolerance
    ) -> Pairs:
        """Return the matches that agree with that of the current experience, which comes last."""
        of_map = {
            name: column[self.sightings["map"] == where].numpy()
            for name, column in ((name, self.sightings[name]) for name in self.sightings.columns)
        }
        pairs = Pairs(*(of_map[name] for name in Pairs._fields))
        for group in agreeing(pairs, partial.poses, loaded.poses, limits):
            agreed = pairs.pick(group)
            here = agreed.partial == partial.current
            if here.any():
                self.tally["agreed"][where] = max(
                    int(self.tally["agreed"][where]), n_places(agreed)
                )
                return agreed.pick(np.argsort(here, kind="stable"))
        return Pairs.of([])

    def store(self) -> None:
        """Add a row for another stored map."""
        self.tally.append(alike=0, agreed=0)

    def forget(self) -> None:
        """Drop all matches after a refused merge."""
        self.sightings.replace(**{n: self.sightings[n][:0] for n in self.sightings.columns})
