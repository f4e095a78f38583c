"""How often each view was visited."""

import math

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neuroslam.config import Section
from neuroslam.state.mergeable import about_now, summed_by_view, view_id
from neuroslam.state.population import Population, StepInput
from neuroslam.state.registry import register
from neuroslam.types import NO_TEMPLATE


class VisitsConfig(Section):
    """Its parameters: the table [visits] of a config."""

    away_s: float = Field(
        default=1.0, ge=0, description="a view that returns within it is the same visit"
    )


def count(visits: Tensor, view: int) -> Tensor:
    """Count a visit: n_i <- n_i + [i = view]. The table grows until it has a row for the view."""
    grown = torch.nn.functional.pad(visits, (0, max(0, view + 1 - len(visits))))
    return grown + (torch.arange(len(grown)) == view)


@register("visits")
class Visits(Population):
    """How often each view was visited."""

    config_section = VisitsConfig
    needs_views = True
    growing = ("visits",)
    merge_rules = {"visits": summed_by_view, "last": view_id, "since_s": about_now}

    def __init__(self, config: VisitsConfig | None = None) -> None:
        super().__init__()
        self.config = config or VisitsConfig()
        self.register_buffer("visits", torch.zeros(0, dtype=torch.int64))  # learnt: a row per view
        self.register_buffer("last", torch.tensor(NO_TEMPLATE))  # the view seen last
        self.register_buffer("since_s", torch.tensor(0.0, dtype=torch.float64))

    def learn(self, now: StepInput, observation: None) -> None:
        self.since_s = self.since_s + now.motion.dt_s
        view = now.view.template
        if view == NO_TEMPLATE:
            return
        if view != int(self.last) or self.since_s > self.config.away_s:
            self.visits = count(self.visits, view)
        self.last, self.since_s = torch.tensor(view), torch.zeros_like(self.since_s)

    @property
    def rates(self) -> np.ndarray:
        return self.visits.numpy(force=True)

    def counts(self):
        return {"visits": self.visits.sum(), "most_visits": self.rates.max(initial=0)}

    def scalars(self):
        return {"visits/visits": self.visits.sum()}

    def images(self):
        side = math.ceil(math.sqrt(len(self.visits)))
        square = np.pad(self.rates, (0, side**2 - len(self.visits))).reshape(side, side)
        return {"visits/of_each_view": square}

    def tables(self):
        rows = [f"{view},{n}\n" for view, n in enumerate(self.visits.tolist())]
        return {"visits.csv": "view,visits\n" + "".join(rows)}

    @classmethod
    def faults(cls, state, config, n_views, n_experiences):
        if (state["visits"] < 0).any():
            yield "visits.visits: negative"
        if len(state["visits"]) > n_views:
            yield f"visits.visits: {len(state['visits'])} rows, there are {n_views} views"
