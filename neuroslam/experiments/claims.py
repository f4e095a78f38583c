"""What the four papers print, and what this package gives: values, stored values, tolerances."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

Size = Literal["full", "quick"]

PAPERS = {
    "multisession": "Multisession RatSLAM (2023)",
    "python": "Python RatSLAM, documentation (2017)",
    "slrb": "SLRB (2023)",
    "ssp": "SSP-SLAM (2023)",
}
"""Titles of the sources, by the key that tables and claims use."""


class Claim(NamedTuple):
    """A value of a paper, and where an experiment has ours.

    Attributes:
        paper: Key of :data:`PAPERS`.
        item: Table, figure or section.
        says: What is measured.
        experiment: Name of the experiment.
        where: What a row of its results must hold; the last such row counts.
        key: The value in that row.
        printed: The paper's value; ``None``: it prints none, or on a recording that is not public.
        rule: ``<=``: met if ours is at most the bound; ``>=``; ``==``: within ``within`` of it.
        bound: The bound; ``None``: the printed value.
        within: Absolute tolerance of ``==``.
        full: Our stored value at the size of the paper; ``None``: none is stored.
        quick: Our stored value at the quick size.
        drift: Relative difference from the stored value that counts as the same: other machines
            and versions round differently, and a map can then close a loop one frame later.
        table: Name of the list in ``results.json``.
        only_full: At the quick size the value is shown and compared with the stored one, but it
            meets nothing: errors that grow with time are smaller there.
    """

    paper: str
    item: str
    says: str
    experiment: str
    where: Mapping[str, Any]
    key: str
    printed: float | None = None
    rule: Literal["<=", ">=", "=="] = "<="
    bound: float | None = None
    within: float = 0.0
    full: float | None = None
    quick: float | None = None
    drift: float = 0.02
    table: str = "rows"
    only_full: bool = False

    def value(self, results: Mapping[str, Any]) -> float | None:
        """Return our value in the results of the experiment; ``None``: no row has it.

        Example:
            >>> claim = Claim("slrb", "Fig. 0", "error", "x", {"track": "a"}, "error_m")
            >>> claim.value({"rows": [{"track": "a", "error_m": 0.5}, {"track": "b"}]})
            0.5
        """
        rows = results.get(self.table, [])
        rows = rows if isinstance(rows, list) else [rows]
        found = [
            row[self.key]
            for row in rows
            if row.get(self.key) is not None
            and all(row.get(key) == wanted for key, wanted in self.where.items())
        ]
        return float(found[-1]) if found else None

    def target(self) -> float | None:
        """Return the value that ours is compared with; ``None``: there is none."""
        return self.printed if self.bound is None else self.bound

    def met(self, value: float) -> bool | None:
        """Tell whether our value meets the paper's; ``None``: nothing to meet.

        Example:
            >>> claim = Claim("slrb", "Fig. 0", "error", "x", {}, "error_m", printed=0.03)
            >>> claim.met(0.02), claim.met(0.04)
            (True, False)
        """
        target = self.target()
        if target is None:
            return None
        if self.rule == "==":
            return abs(value - target) <= self.within
        return value <= target if self.rule == "<=" else value >= target

    def stored(self, size: Size) -> float | None:
        """Return our stored value of a size."""
        if size == "full":
            return self.full
        return STORED_QUICK.get(self.name, self.quick)

    @property
    def name(self) -> str:
        """Name of the value: experiment, key and row.

        Example:
            >>> Claim("ssp", "Fig. 4", "wall", "ssp-map", {"question": "WALL"}, "similarity").name
            'ssp-map similarity WALL'
        """
        return " ".join([self.experiment, self.key, *map(str, self.where.values())])

    def same(self, value: float, size: Size) -> bool | None:
        """Tell whether our value is the stored one; ``None``: none is stored.

        Example:
            >>> claim = Claim("slrb", "Fig. 0", "error", "x", {}, "error_m", full=1.0)
            >>> claim.same(1.01, "full"), claim.same(1.1, "full"), claim.same(1.0, "quick")
            (True, False, None)
        """
        stored = self.stored(size)
        return None if stored is None else abs(value - stored) <= self.drift * abs(stored)


def _multisession(name: str, item: str, full_share: float, sessions: int) -> list[Claim]:
    many = {"map": "multi-session"}
    share = "RMSE by ICP, share of the map's diagonal; the paper's maps have no scale"
    return [
        Claim("multisession", item, "sessions in one map", name, many, "sessions",
              sessions, "==", full=sessions, quick=sessions),
        Claim("multisession", item, share, name, many, "icp_rmse_rigid_of_diagonal",
              bound=0.01, full=full_share),
    ]  # fmt: skip


_FREE, _CLOSED = {"landmarks": "none"}, {"landmarks": "the same"}
_SPIKES = {"method": "spiking"}
_HAFTING = {"track": "hafting", "method": "SLRB"}

CLAIMS: list[Claim] = [
    *_multisession("virtual-tour", "Sect. 5.1.1, Figs. 9 to 11", 0.0031, 2),
    Claim("multisession", "Sect. 5.1.1", "experiences; as many as in a single session",
          "virtual-tour", {"map": "multi-session"}, "experiences", None, "==", 127, 0.0, full=127),
    Claim("multisession", "Fig. 12", "experiences without the shift; more than with it",
          "virtual-tour-no-shift", {}, "experiences", None, ">=", 128, full=130, quick=130),
    *_multisession("lab-tour", "Sect. 5.2, Figs. 13, 14", 0.0040, 2),
    *_multisession("five-sessions", "Sect. 5.3, Figs. 15, 16", 0.0051, 5),
    *_multisession("campus", "Sect. 5.4, Figs. 17, 18", 0.0030, 3),
    *(
        Claim("slrb", f"Fig. 3, 4 {name[0]}", "activity by zones as Sect. 2.1 says: 1 is yes",
              "boundary-scenarios", {"scenario": name}, "as_in_the_paper", 1, "==", full=1, quick=1)
        for name in ("A: towards a wall", "C: away from a wall", "D: towards a corner",
                     "B: away from a corner")
    ),
    *(
        Claim("slrb", "Table 1, Fig. 5", f"grid score in the {arena} after {time_s} s",
              "grid-scores", {"arena": arena, "time_s": float(time_s)}, "gridness_silent",
              printed, ">=", only_full=time_s > 60)
        for arena, at_60, at_360 in (("triangle", 0.32, 0.74), ("pentagon", 0.35, 0.78),
                                     ("nonagon", 0.34, 0.85))
        for time_s, printed in ((60, at_60), (360, at_360))
    ),
    Claim("slrb", "Sect. 4.1, Table 2", "mean error at 1800 s in m (the text; Table 2: 0.37)",
          "grid-comparison", {"time_s": 1800.0}, "mean_error_m", 0.037, table="boundary_cells",
          full=0.038, only_full=True, drift=0.05),
    *(
        Claim("slrb", "Table 3, Fig. 11", f"grid score of {method} at 30 min", "grid-comparison",
              {"method": method, "time_min": 30.0}, "gridness_silent", printed, "==", None, 0.05,
              full=full, only_full=True)
        for method, printed, full in (("OI", 0.43, 0.95), ("CAN", 0.65, 1.02), ("SLRB", 0.86, 1.38))
    ),
    Claim("slrb", "Fig. 7", "distance between place cells of least error, in m",
          "threshold-sweep", {}, "our_threshold_of_least_winner_error_m", 0.06, "==", None, 1e-9,
          full=0.04, table="whole", only_full=True),
    Claim("slrb", "Sect. 4.3, Fig. 13b", "mean error on Hafting's circle in m",
          "place-map", _HAFTING, "mean_error_m", 0.031, full=0.038, table="details",
          only_full=True, drift=0.05),
    Claim("slrb", "Sect. 4.3", "error below competitive Hebb, in %", "place-map", _HAFTING,
          "mean_error_m_below_hebb_percent", 47.2, ">=", full=79.0, table="details",
          only_full=True, drift=0.05),
    Claim("slrb", "Sect. 4.3", "error below RatSLAM, in %", "place-map", _HAFTING,
          "mean_error_m_below_ratslam_percent", 56.9, ">=", full=79.0, table="details",
          only_full=True, drift=0.05),
    Claim("slrb", "Fig. 13a", "place cells at 30 min; near 300", "place-map", _HAFTING, "cells",
          300, full=435, table="details", only_full=True, drift=0.05),
    Claim("ssp", "Sect. 3.3, Figs. 8, 9", "trajectory error of SSP-SLAM", "ssp-localisation",
          _SPIKES | _CLOSED, "ate_mean_m", 0.0529, full=0.009, drift=0.1, only_full=True),
    Claim("ssp", "Sect. 3.3, Figs. 8, 9", "error of path integration alone", "ssp-localisation",
          _SPIKES | _FREE, "ate_mean_m", 0.7876, full=0.015, drift=0.1,
          only_full=True),
    Claim("ssp", "Fig. 4", "error of the answer BLUE * TRIANGLE, in m", "ssp-map",
          {"question": "BLUE * TRIANGLE"}, "error_m", bound=0.05, full=0.013, drift=0.3,
          only_full=True),
    Claim("ssp", "Fig. 4", "similarity of the wall", "ssp-map", {"question": "WALL"}, "similarity",
          None, ">=", 0.9, full=0.983, only_full=True),
    Claim("ssp", "Fig. 7A", "grid score with the map", "ssp-activity",
          {"life": "ours, corrected"}, "gridness_median", None, ">=", 0.9, full=0.99,
          only_full=True),
    Claim("ssp", "Sect. 3.4, Fig. 10", "RMSE in three dimensions in m", "ssp-3d",
          {"tier": "spiking", "what": "SLAM"}, "rmse_m", bound=0.05,
          full=0.024, drift=0.1, only_full=True),
    Claim("ssp", "Sect. 3.5, Fig. 11", "RMSE on KITTI 00, 90 000 neurons, box of 1.8",
          "ssp-kitti", {"integrator": "plain, 90k neurons"}, "rmse", bound=0.1, full=0.017,
          only_full=True, drift=0.1),
    Claim("ssp", "Sect. 3.5, Fig. 11", "RMSE on KITTI 00, 9 000 neurons, box of 1.8",
          "ssp-kitti", {"integrator": "plain, 9k neurons"}, "rmse", bound=0.1,
          full=0.019, drift=0.1, only_full=True),
]  # fmt: skip

STORED_QUICK: dict[str, float] = {
    "virtual-tour icp_rmse_rigid_of_diagonal multi-session": 0.003103,
    "virtual-tour experiences multi-session": 127.0,
    "lab-tour icp_rmse_rigid_of_diagonal multi-session": 0.004006,
    "five-sessions icp_rmse_rigid_of_diagonal multi-session": 0.005381,
    "grid-scores gridness_silent triangle 60.0": 0.3609,
    "grid-scores gridness_silent pentagon 60.0": 0.3525,
    "grid-scores gridness_silent nonagon 60.0": 0.4127,
    "threshold-sweep our_threshold_of_least_winner_error_m": 0.04,
    "place-map mean_error_m hafting SLRB": 0.02587,
    "place-map mean_error_m_below_hebb_percent hafting SLRB": 28.53,
    "place-map mean_error_m_below_ratslam_percent hafting SLRB": 30.01,
    "place-map cells hafting SLRB": 226.0,
    "ssp-localisation ate_mean_m spiking the same": 0.007967,
    "ssp-localisation ate_mean_m spiking none": 0.008876,
    "ssp-3d rmse_m spiking SLAM": 0.009078,
}
"""Our stored values at the quick size, by :attr:`Claim.name`."""

NO_NUMBERS = {
    "python": "The documentation prints no table, and its figures hold no number; the tutorial's "
    "two drives are compared with C++ OpenRatSLAM by tests (README, Measured).",
}
"""Papers without a value to compare, and why."""

QUICK: dict[str, dict[str, Any]] = {
    "virtual-tour": {},
    "virtual-tour-no-shift": {},
    "lab-tour": {},
    "five-sessions": {},
    "boundary-scenarios": {},
    "grid-scores": {"minutes": 1.0, "n_seeds": 1},
    "grid-comparison": {"minutes": 2.0, "n_seeds": 1, "n_other_seeds": 1},
    "threshold-sweep": {"minutes": 2.0, "seeds": range(1), "thresholds_m": (0.04, 0.06, 0.1)},
    "place-map": {"minutes": 2.0, "seeds": range(1), "tracks": ("hafting",)},
    "ssp-localisation": {"seconds": 20.0, "n_trials": 2, "methods": ("algebraic", "spiking")},
    "ssp-map": {"seconds": 30.0, "n_random_maps": 3, "random_seconds": 20.0},
    "ssp-activity": {"seconds": 20.0},
    "ssp-3d": {"seconds": 20.0, "n_trials": 1},
    "ssp-kitti": {"seconds": 20.0, "budgets": (9000,)},
}
"""Arguments of the quick size; an experiment that is not here is left out of it."""
