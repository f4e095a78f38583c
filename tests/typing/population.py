"""A population of a user's that senses, corrects, remembers and merges, in types throughout."""

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.config import Section
from neuroslam.geometry import wrap_angle
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State, rows_of_views
from neuroslam.state.population import Belief, Correction, Picture, Population, StepInput
from neuroslam.state.registry import register
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import Frame, StepResult, Velocity


class SunConfig(Section):
    """Parameters of a compass that is learnt from the brightness of the sky."""

    gain: float = Field(default=0.1, gt=0, le=1, description="share of the error that is corrected")
    seed: int = Field(default=0, description="of the noise")


class Now(Scalars):
    """What the sun tells now."""

    bearing_rad: float
    n_seen: int


@register("sun")
class Sun(Population):
    """Remembers under which bearing the sun stood at each view."""

    config_section = SunConfig
    needs_views = True

    brightness: Tensor

    def __init__(self, config: SunConfig | None = None) -> None:
        super().__init__()
        self.config = config or SunConfig()
        self.now = Now(bearing_rad=0.0, n_seen=0)
        self.views = GrowingTable({"bearing_rad": ((), torch.float64)})
        self.register_buffer("brightness", torch.zeros(1, dtype=torch.float64))

    def observe(self, frame: Frame) -> float | None:
        if frame.image is None:
            return None
        columns = frame.image.reshape(*frame.image.shape[:2], -1).mean(axis=(0, 2))
        return float(np.argmax(columns)) / len(columns)

    def step(self, now: StepInput, observation: float | None) -> Correction | None:
        if observation is None:
            return None
        self.brightness = self.brightness + observation
        before, self.now.bearing_rad = self.now.bearing_rad, observation
        self.now.n_seen += 1
        return Correction(turn_rad=self.config.gain * wrap_angle(observation - before))

    def follow(self, correction: Correction) -> None:
        self.now.bearing_rad += correction.turn_rad

    def learn(self, now: StepInput, observation: float | None) -> None:
        while self.views.n <= now.view.template:
            self.views.append(bearing_rad=self.now.bearing_rad)

    def recall(
        self, now: StepInput, observation: float | None, belief: Belief | None
    ) -> Correction | None:
        if belief is None or now.view.is_new or not 0 <= now.view.template < self.views.n:
            return None
        known = float(self.views["bearing_rad"][now.view.template])
        return Correction(turn_rad=known - self.now.bearing_rad, heading_rad=belief.pose.theta_rad)

    @property
    def rates(self) -> np.ndarray:
        return self.views["bearing_rad"].numpy(force=True)

    def counts(self) -> dict[str, float]:
        return {"bearings": self.views.n}

    def images(self) -> dict[str, Picture]:
        return {"sun/bearings": self.rates[None]}

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        name = "views.bearing_rad"
        return dict(partial) | {name: rows_of_views(loaded[name], partial[name], join)}


def drive(path: str) -> float:
    """Run, save, load and ask a brain that has such a population."""
    brain = NavigationBrain(BrainConfig(cells=("pose", "sun")))
    result: StepResult = brain(Frame(0, 0.0, np.zeros((120, 160), np.uint8), Velocity(0.5, 0.0)))
    save_brain(brain, path)
    again: NavigationBrain = load_brain(path)
    sun = again.populations["sun"]
    assert isinstance(sun, Sun)
    gain: float = sun.config.gain
    x_m, y_m, theta_rad = result.pose
    frame: int = again.clock.frame
    session: str = again.sessions.now.name
    stored: list[int] = [one.map.n for one in again.stored]
    print(frame, session, stored, again.map.n_links, sun.now.n_seen, x_m + y_m + theta_rad)
    return gain * sun.now.bearing_rad
