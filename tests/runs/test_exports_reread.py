"""What is exported is read by the programs it is for: g2o readers, evo and networkx."""

import math
import re

import networkx as nx
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import BrainConfig
from neuroslam.evaluation.trajectory import absolute_trajectory_error, read_tum
from neuroslam.runs.export import export
from neuroslam.runs.run import run
from neuroslam.sensors import open_source

CORRIDOR = "world:corridor?width=64&height=40&frames_per_lap=60&laps=2&noise=0.05"
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?")
WORDS = {"VERTEX_SE2": (1, 3), "EDGE_SE2": (2, 9), "FIX": (1, 0)}


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    """A lap and a half with a camera: a loop is closed."""
    out = tmp_path_factory.mktemp("camera") / "run"
    run(CORRIDOR, out, stop=90, tensorboard=False)
    return out


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """A circle without a camera, driven one and a half times."""
    folder = tmp_path_factory.mktemp("wheels")
    (folder / "motion.csv").write_text("v_m_s,w_rad_s\n" + "1,0.5\n" * 380)
    config = BrainConfig(cells=("place",))
    run(folder / "motion.csv", folder / "run", config, tensorboard=False)
    return folder / "run"


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two sessions on one map."""
    ellipse = "world:ellipse?laps=2&width=256&height=64"
    first, second = NavigationBrain(), NavigationBrain()
    for frame in open_source(ellipse).frames(0, 300):
        first(frame)
    second.store(first)
    for frame in open_source(ellipse).frames(320, 450):
        second(frame)
    assert len(second.sessions.merges) == 1
    file = tmp_path_factory.mktemp("two") / "brain.safetensors"
    save_brain(second, file)
    return file


MAPS = pytest.mark.parametrize("name", ["camera", "wheels", "two"])


def brain_of(path):
    return load_brain(path / "brain.safetensors" if path.is_dir() else path)


def read_strictly(text):
    """Read g2o by its grammar: vertices, then edges between them, then what is fixed.

    A reader of the kind that stops at the first line it does not know (FIX is one to some) has all
    vertices and edges by then.
    """
    assert text.isascii()
    assert text.endswith("\n")
    order = list(WORDS)
    at, vertices, edges, fixed = 0, {}, [], []
    for line in text.splitlines():
        tag, *words = line.split(" ")
        ids, numbers = WORDS[tag]
        assert len(words) == ids + numbers, line
        assert order.index(tag) >= at, f"{tag} after {order[at]}"
        at = order.index(tag)
        assert all(re.fullmatch(r"\d+", word) for word in words[:ids]), line
        assert all(NUMBER.fullmatch(word) for word in words[ids:]), line
        names, values = [int(w) for w in words[:ids]], [float(w) for w in words[ids:]]
        assert all(map(math.isfinite, values))
        if tag == "VERTEX_SE2":
            assert names[0] not in vertices
            vertices[names[0]] = values
        elif tag == "EDGE_SE2":
            assert set(names) <= vertices.keys()
            information = np.zeros((3, 3))
            information[np.triu_indices(3)] = values[3:]
            information += np.triu(information, 1).T
            assert np.linalg.eigvalsh(information).min() > 0
            edges.append((*names, *values[:3]))
        else:
            assert names[0] in vertices
            fixed.append(names[0])
    return vertices, edges, fixed


@MAPS
def test_a_strict_reader_of_g2o_gets_every_vertex_and_edge(name, request, tmp_path):
    path = request.getfixturevalue(name)
    brain = brain_of(path)
    text = export(path, tmp_path / "map.g2o").read_text()
    vertices, edges, fixed = read_strictly(text)
    np.testing.assert_array_equal(list(vertices.values()), brain.map.poses)
    links = brain.map.links
    np.testing.assert_array_equal(
        [edge[:2] for edge in edges], np.column_stack([links.source, links.target])
    )
    assert len(edges) > 0
    assert fixed == [0]
    assert text.splitlines()[-1] == "FIX 0"


def test_the_case_of_lost_edges_has_them_all_before_fix(shared, tmp_path, call):
    case = shared / "cases" / "g2o_edges_lost_in_gtsam"
    if not case.is_dir():
        pytest.skip("no cases beside the checkout")
    out, to = tmp_path / "m", tmp_path / "map.g2o"
    preset = ("--preset", "slrb", "--no-tensorboard")
    assert call("run", case / "motion.csv", "-o", out, *preset).code == 0
    assert call("export", out, to).code == 0
    before, _, after = to.read_text().partition("FIX 0\n")
    assert (before.count("VERTEX_SE2"), before.count("EDGE_SE2"), after) == (126, 126, "")


@MAPS
def test_evo_reads_the_track_and_finds_it_sound(name, request, tmp_path):
    path = request.getfixturevalue(name)
    to = export(path, tmp_path / "track.tum")
    track = file_interface.read_tum_trajectory_file(str(to))
    sound, details = track.check()
    assert sound, details
    ours = read_tum(to)
    np.testing.assert_array_equal(track.timestamps, ours.times_s)
    np.testing.assert_allclose(track.positions_xyz[:, :2], ours.poses[:, :2], atol=1e-9)


def test_evo_measures_the_error_that_is_measured_here(camera, tmp_path):
    to, true = export(camera, tmp_path / "track.tum"), tmp_path / "true.tum"
    frames = list(open_source(CORRIDOR).frames(stop=90))
    true.write_text(
        "".join(
            f"{f.time_s:.9f} {f.truth.x_m:.9f} {f.truth.y_m:.9f} 0 0 0 "
            f"{math.sin(f.truth.theta_rad / 2):.12f} {math.cos(f.truth.theta_rad / 2):.12f}\n"
            for f in frames
        )
    )
    ours, truth = read_tum(to), read_tum(true)
    error = absolute_trajectory_error(ours.poses[:, :2], truth.poses[:, :2], "rigid").rmse
    pair = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(str(true)),
        file_interface.read_tum_trajectory_file(str(to)),
    )
    pair[1].align(pair[0])
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(pair)
    assert ape.get_statistic(metrics.StatisticsType.rmse) == pytest.approx(error, rel=1e-6)


@MAPS
def test_networkx_reads_nodes_and_edges_with_their_numbers(name, request, tmp_path):
    path = request.getfixturevalue(name)
    brain = brain_of(path)
    graph = nx.read_graphml(export(path, tmp_path / "map.graphml"))
    links = brain.map.links
    assert graph.is_directed()
    assert graph.number_of_nodes() == brain.map.n
    assert graph.number_of_edges() == len(links.source)
    for i, pose in enumerate(brain.map.poses.tolist()):
        node = graph.nodes[f"n{i}"]
        assert [node[key] for key in ("x_m", "y_m", "theta_rad")] == pose
        assert isinstance(node["template"], int)
        assert isinstance(node["session"], str)
    lengths = {}
    for source, target, data in graph.edges(data=True):
        lengths.setdefault((source, target), []).append(data["distance_m"])
    expected = {}
    for source, target, d in zip(links.source, links.target, links.distance_m, strict=True):
        expected.setdefault((f"n{source}", f"n{target}"), []).append(float(d))
    assert {k: sorted(v) for k, v in lengths.items()} == {k: sorted(v) for k, v in expected.items()}
    assert nx.is_weakly_connected(graph)
