import numpy as np
import pytest

pytest.importorskip("ratinabox", reason="needs the extra rodent")

import matplotlib.pyplot as plt
from ratinabox.Agent import Agent
from ratinabox.Environment import Environment

from neuroslam.adapters.ratinabox import (
    BoundaryNeurons,
    GridNeurons,
    HeadDirectionNeurons,
    PlaceNeurons,
)
from neuroslam.config import PlaceCellConfig
from neuroslam.errors import ConfigError, SourceError
from neuroslam.worlds.environment import arena_of_environment

WALL = [[0.5, 0.0], [0.5, 0.5]]


@pytest.fixture(scope="module")
def driven():
    """Populations on a rat for 30 s in a box with a wall, and where it was."""
    before = np.random.get_state()
    np.random.seed(1)
    try:
        agent = Agent(Environment({"dx": 0.05, "walls": [WALL]}), {"dt": 0.05})
        populations = [
            BoundaryNeurons(agent, {"max_fr": 20.0}),
            GridNeurons(agent),
            PlaceNeurons(agent, {"n": 10, "config": PlaceCellConfig(threshold_m=0.1)}),
            HeadDirectionNeurons(agent),
        ]
        for _ in range(500):
            agent.update()
            for cells in populations:
                cells.update()
    finally:
        np.random.set_state(before)
    return agent, populations


def recorded(cells):
    return np.array(cells.history["firingrate"])


def test_grid_cells_driven_by_motion_fire_as_at_rest_at_the_position_of_the_agent(driven):
    agent, (_, grid, _, _) = driven
    positions = np.array(agent.history["pos"])[50:]
    rest = grid.get_state(evaluate_at=None, pos=positions).T
    # They follow with one step of lateral inhibition: at most 2.5 cm of walking.
    assert np.abs(rest - recorded(grid)[50:]).max() < 0.03
    assert rest.max() > 0.9


def test_boundary_cells_prefer_the_wall_that_is_at_their_bearing_and_distance(driven):
    _, (boundary, *_) = driven
    cells, config = boundary.cells, boundary.cells.config
    away = float(cells.preferred_m[1])
    rates = boundary.get_state(evaluate_at=None, pos=[[1.0 - away, 0.8], [0.5 - away, 0.25]])
    for at in rates.T:  # a wall of the box, then the free-standing one; both are to the east
        assert divmod(int(at.argmax()), config.n_distances) == (0, 1)
        assert at.max() == pytest.approx(20.0, rel=1e-3)  # Hz, as max_fr says


def test_place_cells_are_recruited_up_to_n_and_fire_at_their_centres(driven):
    _, (_, _, place, _) = driven
    assert place.n_recruited == 10  # more without that limit
    centres = place.cells.centres_m[0, : place.n_recruited].numpy()
    rates = place.get_state(evaluate_at=None, pos=centres)
    assert rates.shape == (10, 10)
    np.testing.assert_array_equal(rates.argmax(axis=0), np.arange(10))


def test_the_bump_of_head_direction_cells_is_where_the_agent_faces(driven):
    agent, (*_, heading) = driven
    facing = agent.head_direction
    rest = heading.get_state(evaluate_at=None, pos=[agent.pos], head_direction=facing)[:, 0]
    np.testing.assert_allclose(rest, heading.firingrate, atol=1e-6)
    fires_most = np.deg2rad(3.0 * heading.firingrate.argmax())
    assert np.cos(fires_most) * facing[0] + np.sin(fires_most) * facing[1] > np.cos(0.06)


@pytest.mark.parametrize("which", range(4))
def test_the_plots_of_ratinabox_show_the_cells(driven, which):
    cells = driven[1][which]
    fig, axes = cells.plot_rate_map(chosen_neurons=[1, 2])
    shown = axes[0].images[0].get_array()
    truth = cells.get_state(evaluate_at="all")[1].reshape(shown.shape)
    np.testing.assert_allclose(shown, truth)
    plt.close(fig)
    fig, axes = cells.plot_rate_timeseries(chosen_neurons=[1, 2])
    assert axes.get_xlabel() == "Time / min"
    plt.close(fig)


def test_a_second_question_about_the_same_instant_changes_nothing(driven):
    _, populations = driven
    for cells in populations:
        np.testing.assert_array_equal(cells.get_state()[:, 0], cells.firingrate)


def test_the_arena_of_an_environment_has_its_boundary_holes_and_walls():
    hole = [[0.6, 0.6], [0.8, 0.6], [0.8, 0.8], [0.6, 0.8]]
    environment = Environment({"holes": [hole], "walls": [WALL]})
    environment.add_wall([[0.0, 0.9], [0.3, 0.9]])
    arena = arena_of_environment(environment)
    assert (arena.n_walls, len(arena.holes), len(arena.walls)) == (10, 1, 2)
    np.testing.assert_allclose(arena.boundary, environment.boundary)


def test_environments_that_the_cells_cannot_map_are_refused():
    line = Agent(Environment({"dimensionality": "1D", "boundary_conditions": "periodic"}))
    ring = Agent(Environment({"boundary_conditions": "periodic"}))
    with pytest.raises(SourceError, match="is 2D with periodic boundaries; expected 2D and solid"):
        GridNeurons(ring)
    with pytest.raises(ConfigError, match="environment is 1D; expected 2D"):
        HeadDirectionNeurons(line)
