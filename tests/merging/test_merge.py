"""Two brains become one: the algebra of a merge, the authors' program as oracle, its refusals."""

import json
import math
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import f
from torch import nn

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.cells.convolve import Packet
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles
from neuroslam.mapping.overlap import Pairs, Tolerance, agreeing, n_places
from neuroslam.merging.mapped import differing_keys
from neuroslam.merging.match import find_match
from neuroslam.merging.states import make_join, merge_states
from neuroslam.runs.verify import verify
from neuroslam.sensors import open_source
from neuroslam.state.match import Match
from neuroslam.state.mergeable import Mergeable
from neuroslam.state.sessions import Session
from neuroslam.types import NO_TEMPLATE, Motion, PoseEstimate, ViewMatch

few = settings(max_examples=15, deadline=None)
seeds = st.integers(0, 2**32 - 1)
turns = st.one_of(st.just(0.0), st.floats(-math.pi, math.pi))
VIEW = {"template_width": 12, "template_height": 4, "shift_match": 1}
BLIND = ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)


def small(cells="turn", **view) -> BrainConfig:
    return BrainConfig(view=VIEW | view, sessions={"cells": cells})


def add_links(brain, ends, rng=None):
    """Link places by what their poses say, a little off if a generator is given."""
    poses = brain.map.poses
    for source, target in ends:
        dx, dy, _ = poses[target] - poses[source]
        noise = np.zeros(3) if rng is None else rng.normal(0.0, 0.02, 3)
        brain.map.links_table.append(
            source=source,
            target=target,
            distance_m=max(0.0, math.hypot(dx, dy) + noise[0]),
            heading_rad=wrap_angle(math.atan2(dy, dx) - poses[source, 2] + noise[1]),
            facing_rad=wrap_angle(poses[target, 2] - poses[source, 2] + noise[2]),
            duration_s=1.0 + 0.01 * target,
        )


def put_packet(cells, at: PoseEstimate) -> None:
    """Put the activity at a point between cells, and let it settle."""
    cells.packet = Packet(torch.ones(1, 1, 1).to(cells.window), (0, 0, 0), cells.shape)
    corner = [math.floor(c) for c in (at.theta, at.y, at.x)]
    dense = torch.zeros(cells.shape).to(cells.window)
    for bits in np.ndindex(2, 2, 2):
        weight = 1.0
        for bit, low, exact in zip(bits, corner, (at.theta, at.y, at.x), strict=True):
            weight *= exact - low if bit else 1.0 - (exact - low)
        k, j, i = ((low + bit) % n for low, bit, n in zip(corner, bits, cells.shape, strict=True))
        dense[k, j, i] = weight
    cells.activity = dense
    for _ in range(3):
        cells(Motion(0.0, 0.0, 0.1), BLIND)


def synthetic(seed, n=9, config=None, session=1, shared=False):
    """A brain with random views, places on a random walk, a chain of links and some loops."""
    rng = np.random.default_rng(seed)
    config = config or small()
    brain = NavigationBrain(config)
    size = (config.view.template_height, config.view.template_width)
    torus = np.array(brain.map.torus)
    views = [*range(n), 0, n // 2] if shared else [*range(n)]
    for _ in range(n):
        brain.view.learn(rng.random(size))
        x, y, theta = rng.random(3) * torus
        brain.pose_cells.bindings.append(x=x, y=y, theta=theta, decay=rng.random())
    headings = np.cumsum(rng.normal(0.0, 0.4, len(views))) + rng.uniform(-3, 3)
    steps = np.column_stack([np.cos(headings), np.sin(headings)]) * rng.uniform(0.5, 1.5)
    at = np.cumsum(steps, axis=0) + rng.normal(0.0, 30.0, 2)
    for i, view in enumerate(views):
        brain.map.experiences.append(
            pose=torch.tensor([*at[i], wrap_angle(headings[i])], dtype=torch.float64),
            cell=torch.from_numpy(rng.random(3) * torus),
            template=view,
            first_frame=10 * i + session,
            session=session,
            number=i,
        )
    m = len(views)
    add_links(brain, [(i, i + 1) for i in range(m - 1)] + [(m - 1, 2), (3, 0)], rng)
    state = brain.map.state
    state.session, state.made, state.current = session, m, int(rng.integers(m))
    state.dx_m, state.dy_m, state.facing_rad = rng.normal(0.0, 0.1, 3)
    brain.sessions.sessions.append(Session(session, f"synthetic {session}", frames=10 * m))
    brain.clock.frame = brain.clock.frames_seen = 10 * m
    put_packet(brain.pose_cells, PoseEstimate(*(rng.random(3) * torus)))
    return brain


def frozen(brain) -> dict[str, bytes]:
    return {k: v.clone().contiguous().numpy().tobytes() for k, v in brain.state_dict().items()}


def equal(one: NavigationBrain, other: NavigationBrain) -> bool:
    a, b = one.state_dict(), other.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def unchecked(loaded, partial, match):
    """Merge without the check that refuses contradicting maps."""
    state, join = merge_states(
        loaded.state_dict(), partial.state_dict(), match, partial.config, partial.parts()
    )
    merged = NavigationBrain(partial.config)
    merged.restore(state, [])
    return merged, join


def cells_of(brain) -> np.ndarray:
    return brain.map.experiences["cell"].numpy()


def bindings_of(brain) -> np.ndarray:
    return np.column_stack([brain.pose_cells.bindings[c] for c in ("x", "y", "theta")])


def on_ring(difference, torus):
    """Differences on the torus, each in [-n/2, n/2)."""
    n = np.array(torus)
    return (np.asarray(difference) + n / 2) % n - n / 2


# --- the authors' program -----------------------------------------------------------------------


class Oracle:
    """Session A, session B and what the authors' program made of them; see its README."""

    def __init__(self, folder):
        def table(name):
            return np.loadtxt(folder / f"merge_{name}.csv", delimiter=",", skiprows=1)

        self.info = json.loads((folder / "merge_info.json").read_text())
        self.exps = {name: table(f"{name}_exps") for name in ("loaded", "partial", "merged")}
        self.cells = {name: table(f"{name}_pcvt")[:, 1:] for name in ("partial", "merged")}
        self.cells["loaded"] = self.cells["merged"][: self.info["loaded"]["nvt"]]
        for name in ("P_u", "P_z", "p_u", "p_z"):
            setattr(self, name, np.array(self.info[name]))
        self.config = BrainConfig(
            view={"template_width": 40, "template_height": 15, "threshold": 0.07},
            pose_cells={"n_xy": 21, "n_theta": 36, "cell_size_m": 0.2},
            sessions={"cells": "shift"},
        )

    def brain(self, name, session):
        brain = NavigationBrain(self.config)
        rng = np.random.default_rng(session)
        for x, y, theta in self.cells[name]:
            brain.view.learn(rng.random((15, 40)))
            brain.pose_cells.bindings.append(x=x, y=y, theta=theta, decay=1.0)
        for number, *pose, view in self.exps[name]:
            brain.map.experiences.append(
                pose=torch.tensor(pose, dtype=torch.float64),
                cell=torch.from_numpy(self.cells[name][int(view)]),
                template=int(view),
                first_frame=int(number),
                session=session,
                number=int(number),
            )
        add_links(brain, [(i, i + 1) for i in range(brain.map.n - 1)])
        brain.map.state.current, brain.map.state.session = brain.map.n - 1, session
        brain.sessions.sessions.append(Session(session))
        return brain

    @property
    def match(self):
        loaded, partial = (
            int(np.flatnonzero(self.exps[name][:, 4] == self.info[f"{name}_vt"])[0])
            for name in ("loaded", "partial")
        )
        return Match(loaded, partial, error=self.info["err"])


@pytest.fixture(scope="module")
def oracle(shared):
    return Oracle(shared / "refs" / "ratslam")


@pytest.fixture(scope="module")
def after(oracle):
    loaded, partial = oracle.brain("loaded", 1), oracle.brain("partial", 2)
    put_packet(partial.pose_cells, PoseEstimate(*oracle.P_z))
    merged, report = loaded.merge(partial, oracle.match)
    assert merged is not None, report.reason
    return loaded, partial, merged, report


def test_the_reference_tables_are_of_the_match_that_is_tested(oracle):
    u, z = oracle.match.loaded, oracle.match.partial
    assert (u, z) == (3, 40)
    np.testing.assert_array_equal(oracle.exps["loaded"][u, 1:4], oracle.p_u)
    np.testing.assert_array_equal(oracle.exps["partial"][z, 1:4], oracle.p_z)
    np.testing.assert_array_equal(oracle.cells["loaded"][3], oracle.P_u)
    np.testing.assert_array_equal(oracle.cells["partial"][36], oracle.P_z)


def test_merged_experiences_lie_where_the_authors_program_has_them(oracle, after):
    _, _, merged, _ = after
    theirs = oracle.exps["merged"]
    assert merged.map.n == len(theirs) == 148
    apart = merged.map.poses - theirs[:, 1:4]
    apart[:, 2] = wrap_angles(apart[:, 2])
    np.testing.assert_allclose(apart, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(merged.map.experiences["template"], theirs[:, 4])


def test_merged_bindings_are_those_of_the_authors_program(oracle, after):
    _, _, merged, _ = after
    assert merged.view.n == merged.pose_cells.bindings.n == 140
    np.testing.assert_allclose(bindings_of(merged), oracle.cells["merged"], rtol=0, atol=1e-9)
    views = merged.map.experiences["template"].numpy()
    np.testing.assert_allclose(
        cells_of(merged), oracle.cells["merged"][views], rtol=0, atol=1e-9
    )  # fmt: skip


def test_the_matched_experience_comes_to_lie_exactly_on_its_match(oracle, after):
    loaded, partial, _, _ = after
    join = make_join(
        loaded.state_dict(), partial.state_dict(), oracle.match, oracle.config, partial.parts()
    )
    x, y, heading = join.place(oracle.p_z[None])[0]
    assert [x, y] == oracle.p_u[:2].tolist()
    assert heading == pytest.approx(oracle.p_u[2], rel=0, abs=4.5e-16)  # wrapping rounds it


def test_the_row_that_the_reference_drops_is_the_matched_one_only_because_it_is_the_last(oracle):
    """It drops the last view whatever matched; here both are view 36 of 37."""
    shifted = (oracle.cells["partial"] + oracle.P_u - oracle.P_z) % (21, 21, 36)
    np.testing.assert_allclose(shifted[:-1], oracle.cells["merged"][104:], atol=1e-12)
    np.testing.assert_allclose(shifted[-1], oracle.P_u, atol=1e-12)
    assert oracle.info["partial_vt"] == oracle.info["partial"]["nvt"] - 1


def test_a_match_that_is_not_the_last_view_drops_that_view_and_no_other(oracle):
    """The reference would drop view 36 here, and keep view 5 twice."""
    loaded, partial = oracle.brain("loaded", 1), oracle.brain("partial", 2)
    match = Match(3, 5)
    merged, _ = loaded.merge(partial, match)
    pixels = partial.view.templates["pixels"].numpy()
    kept = np.delete(np.arange(37), partial.map.experiences["template"][5])
    np.testing.assert_array_equal(merged.view.templates["pixels"].numpy()[104:], pixels[kept])
    u, z = oracle.cells["loaded"][3], oracle.cells["partial"][5]
    expected = (oracle.cells["partial"][kept] + u - z) % (21, 21, 36)
    np.testing.assert_allclose(bindings_of(merged)[104:], expected, atol=1e-9)


def test_all_links_of_the_matched_experience_belong_to_its_match(oracle):
    """The authors' program reroutes one of them: a place in mid-session would lose its others."""
    loaded, partial = oracle.brain("loaded", 1), oracle.brain("partial", 2)
    add_links(partial, [(5, 30), (25, 5)])  # besides 4 -> 5 and 5 -> 6: two out, two in
    merged, _ = loaded.merge(partial, Match(3, 5))
    links, n = merged.map.links, loaded.map.n_links
    source, target = links.source[n:], links.target[n:]
    assert merged.map.n_links == n + partial.map.n_links
    assert ((source == 3).sum(), (target == 3).sum()) == (2, 2)
    assert merged.map.neighbours(3) == [2, 4, 108 + 4, 108 + 5, 108 + 24, 108 + 29]
    np.testing.assert_allclose(merged.map.residuals_m, 0.0, atol=1e-9)


def test_the_packet_moves_to_the_matched_pose_and_not_to_the_middle(oracle, after):
    """In the authors' program it stays: its belief after the merge is the middle of the network."""
    _, partial, merged, _ = after
    assert oracle.info["pc_best_after"] == [10.5, 10.5, 18.0]
    before, now = (np.array(b.pose_cells.estimate) for b in (partial, merged))
    torus = (21, 21, 36)
    np.testing.assert_allclose(on_ring(before - oracle.P_z, torus), 0.0, atol=0.05)
    np.testing.assert_allclose(on_ring(now - oracle.P_u, torus), 0.0, atol=0.05)


def test_the_current_experience_is_the_matched_one_everywhere(oracle, after):
    """In the authors' program the network is at 107, its last place, and the map at 3."""
    _, _, merged, _ = after
    info = oracle.info
    assert (info["net_current_exp_after"], info["map_current_exp_after"]) == (107, 3)
    assert merged.map.current == oracle.match.loaded == 3
    assert merged.map.origin == (1, 3)


def test_the_report_counts_what_the_authors_program_counted(oracle, after):
    _, _, _, report = after
    for what, key in (("views", "nvt"), ("experiences", "nexp"), ("links", "nlinks")):
        expected = {name: oracle.info[name][key] for name in ("loaded", "partial", "merged")}
        assert report.counts[what] == expected
    np.testing.assert_allclose(
        on_ring(np.array(report.cell_shift) - (oracle.P_u - oracle.P_z), (21, 21, 36)), 0.0,
        atol=1e-9,
    )  # fmt: skip


# --- every population has a rule ----------------------------------------------------------------

CONFIGS = {
    "default": BrainConfig(),
    "panoramic": BrainConfig(view={"panoramic": True}),
    "float64 and mean gate": BrainConfig(
        view={"precision": "float64", "mean_gate": True}, pose_cells={"precision": "float64"}
    ),
    "mean gate": BrainConfig(view={"mean_gate": True}),
    "least squares": BrainConfig(map={"solver": "least_squares"}),
    "incremental": BrainConfig(map={"solver": "incremental", "robust": True}),
}


@pytest.fixture(scope="module")
def corridor():
    return list(open_source("world:corridor?laps=1&width=64&height=40").frames(0, 60))


@pytest.mark.parametrize("name", CONFIGS)
def test_every_number_of_a_brain_belongs_to_a_part_with_a_rule(name, corridor):
    config = CONFIGS[name]
    lives = []
    for frames in (corridor[:40], corridor[20:]):
        brain = NavigationBrain(config)
        brain.store(synthetic(7, config=config, session=77))
        for frame in frames:
            brain(frame)
        lives.append(brain)
    loaded, partial = lives
    parts = partial.parts()
    assert all(isinstance(part, Mergeable) for part in parts.values())
    assert all(parts[one.name] is one for one in partial.populations.values())
    assert parts.keys() > {one.name for one in partial.populations.values()}
    for key in partial.state_dict():
        top = key.split(".")[0]
        assert top in parts or top == "stored", key
    join = make_join(
        loaded.state_dict(), partial.state_dict(), Match(0, 0), config, partial.parts()
    )
    for part_name, part in parts.items():
        states = [
            {
                key.removeprefix(f"{part_name}."): value
                for key, value in brain.state_dict().items()
                if key.startswith(f"{part_name}.")
            }
            for brain in lives
        ]
        merged = part.merged(*states, join)
        assert set(merged) == set(states[0]) == set(states[1]), part_name
        assert {k: v.dtype for k, v in merged.items()} == {k: v.dtype for k, v in states[1].items()}
    merged, _ = loaded.merge(partial, Match(0, 0))
    assert len(merged.stored) == 2
    assert set(merged.state_dict()) >= set(partial.state_dict())


def test_a_part_without_a_rule_is_named_and_not_forgotten():
    a, b = synthetic(1), synthetic(2, session=2)
    for brain in (a, b):
        brain.hippocampus = nn.BatchNorm1d(2)
    with pytest.raises(MapError, match="hippocampus"):
        merge_states(a.state_dict(), b.state_dict(), Match(0, 0), b.config, b.parts())


def test_a_number_beside_all_parts_is_named_and_not_forgotten():
    a, b = synthetic(1), synthetic(2, session=2)
    for brain in (a, b):
        brain.register_buffer("mood", torch.zeros(2))
    with pytest.raises(MapError, match="mood"):
        merge_states(a.state_dict(), b.state_dict(), Match(0, 0), b.config, b.parts())


def test_a_rule_that_forgets_a_number_is_named():
    class Forgetful(Mergeable):
        def __init__(self):
            super().__init__()
            self.register_buffer("kept", torch.zeros(1))
            self.register_buffer("lost", torch.zeros(1))

        @staticmethod
        def merged(_loaded, partial, _join):
            return {"kept": partial["kept"]}

    a, b = synthetic(1), synthetic(2, session=2)
    for brain in (a, b):
        brain.olfaction = Forgetful()
    with pytest.raises(MapError, match=r"olfaction has no rule for lost"):
        merge_states(a.state_dict(), b.state_dict(), Match(0, 0), b.config, b.parts())


# --- algebra of one match -----------------------------------------------------------------------


@given(seeds, st.integers(0, 10), st.integers(0, 10), turns, st.booleans())
@few
def test_one_match_places_and_renames_everything_and_changes_no_input(seed, u, z, turn, panoramic):
    config = small(panoramic=panoramic)
    loaded = synthetic(seed, config=config, shared=True)
    partial = synthetic(seed + 1, config=config, session=2, shared=True)
    before = frozen(loaded), frozen(partial)
    merged, report = loaded.merge(partial, Match(u, z, turn))
    assert merged is not None, report.reason
    assert (frozen(loaded), frozen(partial)) == before

    # Counts: one view and one place less than both have, and no link less.
    for part in ("view", "map"):
        assert getattr(merged, part).n == getattr(loaded, part).n + getattr(partial, part).n - 1
    assert merged.map.n_links == loaded.map.n_links + partial.map.n_links
    assert merged.pose_cells.bindings.n == merged.view.n

    # What was loaded is first, bit for bit.
    was, now = loaded.state_dict(), merged.state_dict()
    for table in ("view.templates", "pose_cells.bindings", "map.experiences", "map.links_table"):
        for key in (key for key in was if key.startswith(table)):
            assert torch.equal(now[key][: len(was[key])], was[key]), key

    # The match lies on its match: seen with the turn between them.
    join = make_join(was, partial.state_dict(), Match(u, z, turn), config, partial.parts())
    (placed,) = join.place(partial.map.poses[z : z + 1])
    assert placed[:2].tolist() == loaded.map.poses[u, :2].tolist()
    assert abs(wrap_angle(placed[2] - loaded.map.poses[u, 2] - turn)) < 1e-12

    # Ids: one to one onto what follows the loaded ones; only the match is an old one.
    for ids, n, folded in (
        (join.experiences, loaded.map.n, z),
        (join.views, loaded.view.n, int(partial.map.experiences["template"][z])),
    ):
        rest = np.delete(ids, folded)
        assert rest.tolist() == list(range(n, n + len(rest)))
        assert ids[folded] < n
    assert join.experiences[z] == u
    assert merged.map.current == join.experiences[partial.map.current]

    # Fatigue of the views comes along.
    decay = partial.pose_cells.bindings["decay"][torch.from_numpy(join.kept_views)]
    assert torch.equal(merged.pose_cells.bindings["decay"][loaded.view.n :], decay)


@given(seeds, st.integers(0, 10), st.integers(0, 10), turns)
@few
def test_link_measurements_hold_in_the_heading_of_the_merged_experience(seed, u, z, turn):
    """A link of the matched place is told relative to the heading of what that becomes."""
    loaded, partial = synthetic(seed, shared=True), synthetic(seed + 1, session=2, shared=True)
    merged, _ = loaded.merge(partial, Match(u, z, turn))
    n = loaded.map.n_links

    def facing_off(of):
        links, heading = of.links, of.poses[:, 2]
        return wrap_angles(heading[links.target] - heading[links.source] - links.facing_rad)

    np.testing.assert_array_equal(merged.map.residuals_m[:n], loaded.map.residuals_m)
    np.testing.assert_allclose(merged.map.residuals_m[n:], partial.map.residuals_m, atol=1e-9)
    np.testing.assert_allclose(
        wrap_angles(facing_off(merged.map)[n:] - facing_off(partial.map)), 0.0, atol=1e-9
    )
    for name in ("distance_m", "duration_s"):
        np.testing.assert_array_equal(
            getattr(merged.map.links, name)[n:], getattr(partial.map.links, name)
        )


@given(seeds, st.integers(0, 8), st.integers(0, 8), turns)
@few
def test_the_robot_is_after_the_merge_where_it_was_beside_its_places(seed, u, z, turn):
    loaded, partial = synthetic(seed), synthetic(seed + 1, session=2)
    merged, join = unchecked(loaded, partial, Match(u, z, turn))
    here = np.array([partial.map.pose])
    np.testing.assert_allclose(join.place(here)[0, :2], merged.map.pose[:2], atol=1e-9)
    assert abs(wrap_angle(join.place(here)[0, 2] - merged.map.pose.theta_rad)) < 1e-9


axis = st.one_of(st.sampled_from([0.0, 1e-300, 1e-12, 0.5, 1.0 - 1e-12, 1.0 - 2**-53]),
                 st.floats(0.0, 1.0, exclude_max=True))  # fmt: skip
points = st.lists(st.tuples(axis, axis, axis), min_size=3, max_size=3)


@given(points, turns)
@settings(max_examples=40, deadline=None)
def test_pose_cells_move_by_the_same_way_on_the_torus_also_over_its_seams(ends, turn):
    torus = (21, 21, 36)
    p_u, p_z, p_other = np.minimum(np.array(ends) * torus, np.nextafter(torus, 0.0))
    config = small("shift")
    loaded, partial = synthetic(1, config=config), synthetic(2, config=config, session=2)
    loaded.map.experiences["cell"][4] = torch.from_numpy(p_u)
    partial.map.experiences["cell"][2] = torch.from_numpy(p_z)
    partial.map.experiences["cell"][3] = torch.from_numpy(p_other)
    for name, value in zip(("x", "y", "theta"), p_other, strict=True):
        partial.pose_cells.bindings[name][3] = value
    merged, join = unchecked(loaded, partial, Match(4, 2, turn))
    shift = p_u - p_z + (0.0, 0.0, turn * 36 / TWO_PI)
    for new, old, kept, n in (
        (cells_of(merged), cells_of(partial), join.kept_experiences, loaded.map.n),
        (bindings_of(merged), bindings_of(partial), join.kept_views, loaded.view.n),
    ):
        np.testing.assert_allclose(
            on_ring(new[n:] - old[kept] - shift, torus), 0.0, rtol=0, atol=1e-9
        )
        assert ((new >= 0.0) & (new < torus)).all()
    np.testing.assert_allclose(
        on_ring(np.array(join.cell_shift) - shift, torus), 0.0, rtol=0, atol=1e-9
    )


@given(axis, axis, turns)
@settings(max_examples=40, deadline=None)
def test_cells_of_places_that_share_the_matched_view_stay_on_the_torus(theta_u, theta_z, turn):
    """Their heading is told by the merged view: turned back by what the match turned them."""
    loaded, partial = synthetic(1, shared=True), synthetic(2, session=2, shared=True)
    other = 9  # its view is that of place 0
    loaded.map.experiences["cell"][4, 2] = min(theta_u * 36, np.nextafter(36, 0.0))
    for place in (0, other):
        partial.map.experiences["cell"][place, 2] = min(theta_z * 36, np.nextafter(36, 0.0))
    merged, join = unchecked(loaded, partial, Match(4, 0, turn))
    cell = cells_of(merged)[join.experiences[other]]
    assert on_ring(cell[2] - cells_of(loaded)[4, 2], 36) == pytest.approx(0.0, abs=1e-9)
    assert ((cell >= 0.0) & (cell < (21, 21, 36))).all(), cell


@given(seeds, turns)
@few
def test_the_packet_keeps_its_mass_and_moves_as_the_matched_place_does(seed, turn):
    loaded, partial = synthetic(seed), synthetic(seed + 1, session=2)
    merged, join = unchecked(loaded, partial, Match(1, 2, turn))
    activity = merged.pose_cells.activity
    assert activity.sum().item() == pytest.approx(1.0, abs=1e-5)
    assert activity.min().item() >= 0.0
    moved = np.array(merged.pose_cells.estimate) - np.array(partial.pose_cells.estimate)
    np.testing.assert_allclose(on_ring(moved - join.cell_shift, (21, 21, 36)), 0.0, atol=0.05)


def test_the_turned_cells_of_the_matched_place_are_those_of_its_match():
    loaded, partial = synthetic(3), synthetic(4, session=2)
    _, join = unchecked(loaded, partial, Match(1, 2, 0.7))
    p_u = cells_of(loaded)[1] + (0.0, 0.0, 0.7 * 36 / TWO_PI)
    np.testing.assert_allclose(
        on_ring(join.experience_cells[2] - p_u, (21, 21, 36)), 0.0, atol=1e-9
    )


@given(seeds, turns)
@few
def test_what_is_only_about_now_is_that_of_the_session_that_goes_on(seed, turn):
    loaded, partial = synthetic(seed, 7), synthetic(seed + 1, session=2)
    loaded.map.add_goal(3)
    for goal in (2, 5, 0):
        partial.map.add_goal(goal)
    partial.view.last.template, partial.pose_cells.last.view = 2, 4
    merged, join = unchecked(loaded, partial, Match(1, 2, turn))
    was, is_now = partial.state_dict(), merged.state_dict()
    kept = ("clock.", "odometry.", "continuity.")
    same = [key for key in was if key.startswith(kept)]
    same += [f"map.state.{name}" for name in ("since_s", "time_s", "session", "made")]
    assert len(same) > len(kept)
    for key in [*same, "pose_cells.slip"]:
        assert torch.equal(is_now[key], was[key]), key
    assert merged.map.goals["experience"].tolist() == join.experiences[[2, 5, 0]].tolist()
    assert merged.view.last.template == join.views[2] == 1
    assert merged.pose_cells.last.view == join.views[4]
    assert merged.sessions.now == partial.sessions.now
    assert [s.id for s in merged.sessions.sessions] == [1, 2]


@given(seeds, st.integers(1, 6), turns)
@few
def test_places_folded_together_keep_one_view_each_and_every_link_once(seed, n_pairs, turn):
    """Several matches at once: what both maps have linked is linked once."""
    rng = np.random.default_rng(seed)
    loaded, partial = synthetic(seed), synthetic(seed + 1, session=2)
    z, u = (rng.permutation(9)[:n_pairs].tolist() for _ in range(2))
    others = Pairs.of([(*pair, turn, 0.01) for pair in zip(z[1:], u[1:], strict=True)])
    merged, join = unchecked(loaded, partial, Match(u[0], z[0], turn, others=others))
    assert merged.view.n == merged.map.n == 18 - n_pairs
    assert join.experiences[z].tolist() == u
    links = merged.map.links
    ends = {frozenset(pair) for pair in zip(links.source, links.target, strict=True)}
    assert len(ends) == merged.map.n_links
    expected = {frozenset(pair) for pair in zip(*loaded.map.links[:2], strict=True)}
    expected |= {
        frozenset(join.experiences[list(pair)].tolist())
        for pair in zip(*partial.map.links[:2], strict=True)
    }
    assert ends == expected
    o = merged.map.origins()
    assert len(set(zip(o.session, o.number, strict=True))) == 18
    folded = {(2, place): (to, turn) for place, to in zip(z, u, strict=True)}
    for session, number, place, turned in zip(o.session, o.number, o.experience, o.turn_rad,
                                              strict=True):  # fmt: skip
        if (session, number) in folded:
            assert place == folded[session, number][0]
            assert abs(wrap_angle(turned - turn)) < 1e-9


@given(seeds, turns)
@few
def test_a_merged_map_passes_verification(seed, turn):
    loaded, partial = synthetic(seed, shared=True), synthetic(seed + 1, session=2, shared=True)
    merged, _ = loaded.merge(partial, Match(1, 2, turn))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "brain.safetensors"
        save_brain(merged, file)
        assert verify(file) == []
        assert equal(load_brain(file), merged)


# --- several merges -----------------------------------------------------------------------------


def now(brain, session, number):
    """What a place of a session is now, and by how much its heading differs from when made."""
    o = brain.map.origins()
    (at,) = np.flatnonzero((o.session == session) & (o.number == number))
    return int(o.experience[at]), float(o.turn_rad[at])


def match_of(loaded, u, partial, z, turn):
    """A match between places named by session and number; ``turn`` between them as made."""
    (i, turned_u), (j, turned_z) = now(loaded, *u), now(partial, *z)
    return Match(i, j, wrap_angle(turn - turned_z + turned_u))


def named_links(brain):
    table = brain.map.experiences
    names = [*zip(table["session"].tolist(), table["number"].tolist(), strict=True)]
    links = brain.map.links
    return sorted(
        (names[s], names[t], round(d, 9), round(wrap_angle(h), 7) % TWO_PI, w)
        for s, t, d, h, w in zip(
            links.source, links.target, links.distance_m, links.heading_rad, links.duration_s,
            strict=True,
        )
    )  # fmt: skip


def named_poses(brain):
    """Poses of all places as made, by session and number, relative to the first."""
    o, poses = brain.map.origins(), brain.map.poses
    rows = {
        (s, k): (*poses[e, :2], poses[e, 2] + turn)
        for s, k, e, turn in zip(o.session, o.number, o.experience, o.turn_rad, strict=True)
    }
    names = sorted(rows)
    table = np.array([rows[name] for name in names])
    x, y, heading = table[0]
    c, s = np.cos(heading), np.sin(heading)
    dx, dy = table[:, 0] - x, table[:, 1] - y
    return names, np.column_stack([c * dx + s * dy, c * dy - s * dx]), table[:, 2] - heading


@given(seeds, st.lists(st.integers(0, 8), min_size=4, max_size=4), turns, turns)
@few
def test_three_maps_in_a_chain_become_one_whichever_two_are_joined_first(seed, places, rho, sigma):
    a, b, c = (synthetic(seed + i, session=i + 1) for i in range(3))
    in_a, b_to_a, b_to_c, in_c = places
    b_to_c = b_to_c if b_to_c != b_to_a else (b_to_c + 1) % 9
    ab, _ = unchecked(a, b, match_of(a, (1, in_a), b, (2, b_to_a), rho))
    left, _ = unchecked(ab, c, match_of(ab, (2, b_to_c), c, (3, in_c), sigma))
    bc, _ = unchecked(b, c, match_of(b, (2, b_to_c), c, (3, in_c), sigma))
    right, _ = unchecked(a, bc, match_of(a, (1, in_a), bc, (2, b_to_a), rho))
    for what in ("view", "map"):
        assert getattr(left, what).n == getattr(right, what).n == 3 * 9 - 2
    names, points, headings = named_poses(left)
    same, points_2, headings_2 = named_poses(right)
    assert names == same
    np.testing.assert_allclose(points, points_2, atol=1e-7)
    np.testing.assert_allclose(wrap_angles(headings - headings_2), 0.0, atol=1e-9)
    for one, other in zip(named_links(left), named_links(right), strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_allclose(one[2:3] + one[4:], other[2:3] + other[4:], atol=1e-8)
        assert abs(wrap_angle(one[3] - other[3])) < 1e-6


@given(seeds, turns, turns)
@few
def test_headings_of_a_place_that_was_folded_twice_add_up(seed, rho, sigma):
    a, b, c = (synthetic(seed + i, session=i + 1) for i in range(3))
    ab, _ = unchecked(a, b, Match(3, 5, rho))
    cab, _ = unchecked(c, ab, Match(2, 3, sigma))
    for name, turned in (((3, 2), 0.0), ((1, 3), sigma), ((2, 5), rho + sigma)):
        place, turn = now(cab, *name)
        assert place == 2
        assert abs(wrap_angle(turn - turned)) < 1e-9


@pytest.mark.parametrize("errors", [(0.05, 0.04, 0.01), (0.05, 0.01, 0.04)])
def test_of_places_with_one_view_the_match_says_what_that_becomes_then_the_most_alike(errors):
    loaded, partial = synthetic(1, shared=True), synthetic(2, session=2, shared=True)
    one, two = (0, 9), (4, 10)  # places of the partial map with one view each
    others = Pairs.of([(two[0], 5, 0.2, errors[1]), (two[1], 6, 0.3, errors[2])])
    _, join = unchecked(loaded, partial, Match(1, one[0], 0.1, 0.05, others=others))
    likeliest, turn = (5, 0.2) if errors[1] < errors[2] else (6, 0.3)
    assert (join.views[4], join.view_turns_rad[4]) == (likeliest, turn)
    others = Pairs.of([(one[1], 7, 0.4, 0.01)])
    _, join = unchecked(loaded, partial, Match(1, one[0], 0.1, 0.05, others=others))
    assert (join.views[0], join.view_turns_rad[0]) == (1, 0.1)


@given(seeds, st.booleans())
@few
def test_a_brain_merged_with_itself_is_that_brain(seed, panoramic):
    brain = synthetic(seed, config=small(panoramic=panoramic), shared=True)
    found = find_match(brain, brain)
    assert len(found.match.pairs.partial) == brain.map.n
    merged, report = brain.merge(brain, found.match)
    assert merged is not None, report.reason
    assert "no experience is new" in report.reason
    was, is_now = brain.state_dict(), merged.state_dict()
    for table in ("view.templates", "pose_cells.bindings", "map.experiences", "map.links_table"):
        for key in (key for key in was if key.startswith(table)):
            assert torch.equal(is_now[key], was[key]), key
    assert merged.map.aliases.n == 0
    assert merged.map.current == brain.map.current


@given(seeds, turns)
@few
def test_a_merge_that_was_done_adds_nothing_when_it_is_done_again(seed, turn):
    a, b = synthetic(seed), synthetic(seed + 1, session=2)
    ab, _ = unchecked(a, b, Match(2, 5, turn))
    for first, second in ((ab, b), (ab, a), (a, ab), (b, ab)):
        found = find_match(first, second)
        assert found.match is not None, found.reason
        again, _ = unchecked(first, second, found.match)
        for count in (lambda x: x.view.n, lambda x: x.map.n, lambda x: x.map.n_links):
            assert count(again) == count(ab)


@pytest.fixture(scope="module")
def ellipse():
    return list(open_source("world:ellipse?laps=1&width=128&height=32").frames(0, 300))


def lived(frames, config=None):
    brain = NavigationBrain(config)
    for frame in frames:
        brain(frame)
    return brain


def test_two_overlapping_halves_of_a_drive_merge_into_the_map_of_the_drive(ellipse):
    whole = lived(ellipse)
    made = whole.map.experiences["first_frame"].numpy()
    cut = int(made[made >= 120][0])  # a new place, so that the second half begins as it goes on
    first, second = lived(ellipse[:200]), lived(ellipse[cut:])
    found = find_match(first, second)
    assert found.match is not None, found.reason
    merged, report = first.merge(second, found.match)
    assert merged is not None, report.reason
    assert (merged.view.n, merged.map.n) == (whole.view.n, whole.map.n)
    assert merged.map.n_links == whole.map.n_links
    np.testing.assert_array_equal(
        np.sort(merged.view.templates["pixels"].numpy(), axis=0),
        np.sort(whole.view.templates["pixels"].numpy(), axis=0),
    )


def test_a_map_and_its_continuation_merge_into_the_continuation(ellipse):
    copy, whole = lived(ellipse[:200]), lived(ellipse)
    for one, other in ((copy, whole), (whole, copy)):
        merged, _ = one.merge(other, find_match(one, other).match)
        for part in ("view", "map"):
            assert getattr(merged, part).n == getattr(whole, part).n
        assert merged.map.n_links == whole.map.n_links
        assert [s.frames for s in merged.sessions.sessions] == [300]


def test_copies_that_were_continued_differently_are_refused(ellipse):
    config = BrainConfig(sessions={"kidnapped": "ignore"})
    brain = lived(ellipse[:100], config)
    state = {k: v.clone() for k, v in brain.state_dict().items()}
    for frame in ellipse[100:200]:
        brain(frame)
    other = NavigationBrain(config)
    other.load_state_dict(state)
    for k, frame in enumerate(ellipse[299:199:-1]):
        other(frame._replace(index=100 + k, time_s=ellipse[100 + k].time_s))
    found = find_match(brain, other)
    assert found.match is None
    assert "continued differently" in found.reason


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [0, 44])
def test_places_that_contradict_each_other_are_refused_and_by_how_much_is_said(far, ellipse):
    first, second = lived(ellipse[:200]), lived(ellipse[100:250])
    found = find_match(first, second).match
    before = frozen(first), frozen(second)
    beside = found.partial + 1  # a link away, and said to be a place metres away
    wrong = found._replace(others=Pairs.of([(beside, far, 0.0, 0.01)]))
    merged, report = first.merge(second, wrong)
    assert merged is None
    assert not report.merged
    assert "the merged map is inconsistent" in report.reason
    assert "--set sessions.residual_factor" in report.reason
    rise, allowed = map(float, re.findall(r"\d+\.\d+", report.reason))
    assert rise > allowed
    assert allowed == pytest.approx(3.0 * f.isf(0.001, 3, 12), abs=0.05)  # of 2 pairs 1 aligns
    assert (frozen(first), frozen(second)) == before


def test_the_rule_of_the_paper_accepts_links_that_do_not_fit(ellipse):
    sessions = {"check_residuals": False}
    first, second = (lived(ellipse[part], BrainConfig(sessions=sessions))
                     for part in (slice(150), slice(100, 250)))  # fmt: skip
    found = find_match(first, second).match
    wrong = found._replace(others=Pairs.of([(found.partial + 1, 0, 0.0, 0.01)]))
    merged, report = first.merge(second, wrong)
    assert report.merged
    assert report.residual_after_m > 2.0 * report.residual_before_m
    assert merged.map.n < first.map.n + second.map.n


def test_an_open_arc_is_not_closed_by_one_wrong_pair(ellipse):
    """The strain of one pair spreads over all links, so that none is torn; odometry knows."""
    first, second = lived(ellipse[:200]), lived(ellipse[100:250])
    found = find_match(first, second).match
    arc = found._replace(others=Pairs.of([(second.map.n - 1, 0, 0.0, 0.01)]))
    merged, report = first.merge(second, arc)
    assert merged is None
    assert "the merged map is inconsistent" in report.reason


def test_maps_made_with_other_views_or_cells_are_refused_and_the_keys_named():
    a = synthetic(1)
    b = synthetic(2, config=small(threshold=0.04), session=2)
    assert differing_keys(a.config, b.config) == ["view.threshold is 0.05 and 0.04"]
    merged, report = a.merge(b, Match(0, 0))
    assert merged is None
    assert "view.threshold is 0.05 and 0.04" in report.reason
    assert "view.threshold is 0.05 and 0.04" in find_match(a, b).reason


@pytest.mark.parametrize(
    ("match", "which"),
    [
        (Match(9, 0), "experience 9 of the loaded map; expected 0 to 8"),
        (Match(0, 9), "experience 9 of the partial map; expected 0 to 8"),
        (Match(-1, 0), "experience -1 of the loaded map"),
        (Match(0, 0, others=Pairs.of([(12, 1, 0.0, 0.0)])), "experience 12 of the partial map"),
    ],
)
def test_a_match_that_names_a_missing_place_is_a_mistake_that_is_named(match, which):
    with pytest.raises(MapError, match=which):
        synthetic(1).merge(synthetic(2, session=2), match)


def test_an_empty_map_meets_nothing():
    assert find_match(NavigationBrain(small()), synthetic(1)).reason == "the first map is empty"
    assert find_match(synthetic(1), NavigationBrain(small())).reason == "the second map is empty"


# --- which places agree -------------------------------------------------------------------------

LIMITS = Tolerance(near_m=40.0, place_m=0.3, drift=0.1, turn_rad=0.5)


def drive(seed, n=12):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.0, 0.5, n))
    at = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    return np.column_stack([at, wrap_angles(heading)])


def moved_rigidly(poses, x, y, turn):
    c, s = math.cos(turn), math.sin(turn)
    return np.column_stack(
        [
            c * poses[:, 0] - s * poses[:, 1] + x,
            s * poses[:, 0] + c * poses[:, 1] + y,
            wrap_angles(poses[:, 2] + turn),
        ]
    )


far = st.floats(-100.0, 100.0)
motions = st.tuples(far, far, st.floats(-math.pi, math.pi))


@given(seeds, motions, motions)
@settings(max_examples=40, deadline=None)
def test_which_places_agree_does_not_depend_on_how_the_maps_lie(seed, motion, other):
    rng = np.random.default_rng(seed)
    places = drive(seed)
    near = places + rng.normal(0.0, 0.02, places.shape)
    right = [(i, i, 0.0, rng.random()) for i in range(0, 12, 2)]
    wrong = [(int(rng.integers(12)), int(rng.integers(12)), 0.0, rng.random()) for _ in range(6)]
    pairs = Pairs.of(right + wrong)
    groups = agreeing(pairs, places, near, LIMITS)
    for first, second in ((motion, (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), motion), (motion, other)):
        again = agreeing(pairs, moved_rigidly(places, *first), moved_rigidly(near, *second), LIMITS)
        assert [g.tolist() for g in again] == [g.tolist() for g in groups]
    for group in groups:
        agreed = pairs.pick(group)
        assert len(set(agreed.partial.tolist())) == len(agreed.partial)
    assert {r[0] for r in right} <= set(pairs.pick(groups[0]).partial.tolist())


def test_places_that_are_wrong_join_neither_the_right_ones_nor_each_other():
    places = drive(3)
    pairs = Pairs.of(
        [(i, i, 0.0, 0.01) for i in range(4)] + [(5, 11, 0.0, 0.01), (8, 6, 0.0, 0.01)]
    )
    groups = [g.tolist() for g in agreeing(pairs, places, places, LIMITS)]
    assert groups == [[0, 1, 2, 3], [4], [5]]


def test_a_place_seen_with_a_wrong_heading_does_not_agree():
    places = drive(4)
    pairs = Pairs.of([(i, i, 0.0, 0.01) for i in range(4)] + [(5, 5, 1.0, 0.01)])
    assert [g.tolist() for g in agreeing(pairs, places, places, LIMITS)] == [[0, 1, 2, 3], [4]]


@pytest.mark.parametrize("wrong", [0, 1])
def test_a_wrong_heading_shows_over_a_long_way_from_whichever_end(wrong):
    places = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    turned = [0.0, 0.0]
    turned[wrong] = 0.4  # within turn_rad; over 10 m that is 4 m aside
    pairs = Pairs.of([(i, i, turned[i], 0.01) for i in range(2)])
    assert [g.tolist() for g in agreeing(pairs, places, places, LIMITS)] == [[0], [1]]


@pytest.mark.parametrize("which", ["partial", "loaded", "both"])
def test_standing_still_never_counts_as_several_places(which):
    places = np.zeros((8, 3))
    rows = {
        "partial": [(0, i, 0.0, 0.01) for i in range(8)],
        "loaded": [(i, 0, 0.0, 0.01) for i in range(8)],
        "both": [(0, 0, 0.0, 0.01)] * 8,
    }[which]
    pairs = Pairs.of(rows)
    groups = agreeing(pairs, places, places, LIMITS)
    assert max(n_places(pairs.pick(group)) for group in groups) == 1


def test_no_pairs_make_no_group():
    assert agreeing(Pairs.of([]), drive(1), drive(2), LIMITS) == []
