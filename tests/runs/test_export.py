"""What is exported is what the map holds, in a form that other programs read."""

import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import CheckpointError, ConfigError, RunError, SourceError
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.geometry import compose, wrap_angles
from neuroslam.runs.export import export
from neuroslam.runs.run import run
from neuroslam.sensors import open_source
from neuroslam.state.sessions import session_name
from neuroslam.types import Pose

ELLIPSE = "world:ellipse?laps=2&width=256&height=64"
CORRIDOR = "world:corridor?width=64&height=40&frames_per_lap=60&laps=2&noise=0.05"
XML = "{http://graphml.graphdrawing.org/xmlns}"
CONFIG = BrainConfig(map={"sigma_m": 0.2, "sigma_rad": 0.05})


def lived(start, stop, *stored) -> NavigationBrain:
    brain = NavigationBrain(CONFIG)
    for one in stored:
        brain.store(one)
    for frame in open_source(ELLIPSE).frames(start, stop):
        brain(frame)
    return brain


def saved(brain, file):
    save_brain(brain, file)
    return file


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Odometry alone placed these places: no loop was closed."""
    brain = lived(0, 300)
    assert brain.map.n_links == brain.map.n - 1
    return saved(brain, tmp_path_factory.mktemp("chain") / "brain.safetensors")


@pytest.fixture(scope="module")
def joined(chain, tmp_path_factory):
    brain = lived(320, 450, load_brain(chain))
    assert len(brain.sessions.merges) == 1
    return saved(brain, tmp_path_factory.mktemp("joined") / "brain.safetensors")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A lap and a half: a loop is closed."""
    out = tmp_path_factory.mktemp("runs") / "run"
    run(CORRIDOR, out, stop=90, tensorboard=False)
    return out


def read_g2o(path):
    """Vertices by id, edges as (from, to, measurement, information), ids that are fixed."""
    vertices, edges, fixed = {}, [], []
    for line in path.read_text().splitlines():
        tag, *words = line.split()
        if tag == "VERTEX_SE2":
            vertices[int(words[0])] = Pose(*map(float, words[1:]))
        elif tag == "EDGE_SE2":
            i, j, *numbers = words
            upper = np.zeros((3, 3))
            upper[np.triu_indices(3)] = list(map(float, numbers[3:]))
            information = upper + np.triu(upper, 1).T
            edges.append((int(i), int(j), Pose(*map(float, numbers[:3])), information))
        else:
            assert tag == "FIX"
            fixed += map(int, words)
    return vertices, edges, fixed


def residuals(vertices, edges):
    """How far each edge's end lies from where the edge has it: metres and radians."""
    apart = np.array(
        [np.subtract(compose(vertices[i], step), vertices[j]) for i, j, step, _ in edges]
    )
    return np.hypot(apart[:, 0], apart[:, 1]), np.abs(wrap_angles(apart[:, 2]))


def test_edges_of_a_chain_are_the_displacements_between_experiences(chain, tmp_path):
    vertices, edges, fixed = read_g2o(export(chain, tmp_path / "map.g2o"))
    metres, radians = residuals(vertices, edges)
    assert metres.max() < 1e-12
    assert radians.max() < 1e-12
    assert fixed == [0]
    np.testing.assert_array_equal(list(vertices.values()), load_brain(chain).map.poses)
    assert list(vertices) == list(range(len(vertices)))


@pytest.mark.parametrize("name", ["joined", "folder"])
def test_edges_are_off_by_as_much_as_the_maps_links(name, tmp_path, request):
    path = request.getfixturevalue(name)
    brain = load_brain(path / "brain.safetensors" if path.is_dir() else path)
    vertices, edges, _ = read_g2o(export(path, tmp_path / "map.g2o"))
    np.testing.assert_allclose(residuals(vertices, edges)[0], brain.map.residuals_m, atol=1e-12)
    assert brain.map.residuals_m.max() > 1e-6  # a loop or a merge pulls


def test_the_information_is_that_of_the_config(chain, tmp_path):
    _, edges, _ = read_g2o(export(chain, tmp_path / "map.g2o"))
    for *_, information in edges:
        np.testing.assert_allclose(information, np.diag([25.0, 25.0, 400.0]), rtol=1e-12)


def test_graphml_has_every_place_and_every_link_with_all_that_is_known(joined, tmp_path):
    brain = load_brain(joined)
    root = ElementTree.parse(export(joined, tmp_path / "map.graphml")).getroot()
    keys = {key.get("id"): key for key in root.iter(f"{XML}key")}
    kinds = {"double": float, "long": int, "string": str}

    def data(element):
        of = element.tag.removeprefix(XML)
        assert all(keys[d.get("key")].get("for") == of for d in element)
        return {d.get("key"): kinds[keys[d.get("key")].get("attr.type")](d.text) for d in element}

    nodes = [data(node) for node in root.iter(f"{XML}node")]
    assert len(nodes) == brain.map.n
    assert [node.get("id") for node in root.iter(f"{XML}node")] == [
        f"n{i}" for i in range(brain.map.n)
    ]
    np.testing.assert_array_equal(
        [[node[name] for name in ("x_m", "y_m", "theta_rad")] for node in nodes], brain.map.poses
    )
    table = brain.map.experiences
    for name in ("template", "number", "first_frame"):
        assert [node[name] for node in nodes] == table[name].tolist()
    names = [session_name(session) for session in table["session"].tolist()]
    assert [node["session"] for node in nodes] == names
    assert set(names) == {session.name for session in brain.sessions.sessions}
    edges, links = list(root.iter(f"{XML}edge")), brain.map.links
    ends = [(int(e.get("source")[1:]), int(e.get("target")[1:])) for e in edges]
    np.testing.assert_array_equal(ends, np.column_stack([links.source, links.target]))
    for name in ("distance_m", "heading_rad", "facing_rad", "duration_s"):
        np.testing.assert_array_equal([data(e)[name] for e in edges], getattr(links, name))


def test_a_track_of_places_has_their_poses_at_the_frames_that_made_them(joined, tmp_path):
    brain = load_brain(joined)
    track = read_tum(export(joined, tmp_path / "map.tum"))
    np.testing.assert_array_equal(track.times_s, brain.map.experiences["first_frame"])
    apart = track.poses - brain.map.poses
    apart[:, 2] = wrap_angles(apart[:, 2])
    assert np.abs(apart).max() < 2e-9


def test_frames_of_a_session_that_begins_again_are_counted_on(joined, tmp_path):
    brain = load_brain(joined)
    frames = brain.map.experiences["first_frame"]
    second = frames >= 320
    before = int(frames[~second].max())
    frames[second] -= int(frames[second].min())  # as if its recording were another file
    file = saved(brain, tmp_path / "brain.safetensors")
    times = read_tum(export(file, tmp_path / "map.tum")).times_s
    np.testing.assert_array_equal(times[~second], frames[~second])
    np.testing.assert_array_equal(times[second], frames[second] + before + 1)


def test_of_a_run_the_track_of_its_frames_is_exported(folder, tmp_path):
    to = export(folder, tmp_path / "deep" / "track.tum")
    assert to.read_bytes() == (folder / "trajectory.tum").read_bytes()
    assert len(read_tum(to).times_s) == 90


def test_the_kind_may_be_given_instead_of_a_suffix(chain, tmp_path):
    one = export(chain, tmp_path / "map.txt", "g2o")
    assert one.read_bytes() == export(chain, tmp_path / "map.G2O").read_bytes()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["map.G2O", "map.txt"]


def test_a_map_of_one_place_has_no_edges(tmp_path):
    file = saved(lived(0, 1), tmp_path / "brain.safetensors")
    vertices, edges, _ = read_g2o(export(file, tmp_path / "map.g2o"))
    assert (len(vertices), edges) == (1, [])
    root = ElementTree.parse(export(file, tmp_path / "map.graphml")).getroot()
    assert len(list(root.iter(f"{XML}node"))) == 1
    assert len(read_tum(export(file, tmp_path / "map.tum")).times_s) == 1


@pytest.mark.parametrize(
    ("to", "kind", "says"),
    [
        (
            "map.svg",
            None,
            "map.svg: unknown export format 'svg'; expected tum, g2o, graphml, nir or mcap",
        ),
        ("map", None, "map: unknown export format ''; expected tum, g2o, graphml, nir or mcap"),
        ("map.g2o", "dot", "unknown export format 'dot'; expected tum, g2o, graphml, nir or mcap"),
        (
            "brain.safetensors",
            "g2o",
            "brain.safetensors: is the brain file to export; choose another output file",
        ),
        ("", "g2o", "cannot be written (Is a directory)"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_a_line(to, kind, says, chain, tmp_path):
    file = shutil.copy(chain, tmp_path / "brain.safetensors")
    with pytest.raises(RunError) as error:
        export(file, tmp_path / to, kind)
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == ["brain.safetensors"]
    assert file.read_bytes() == chain.read_bytes()


def test_an_empty_map_or_a_damaged_run_is_not_exported(folder, tmp_path):
    with pytest.raises(CheckpointError, match="no such brain file"):
        export(tmp_path / "none", tmp_path / "map.g2o")
    with pytest.raises(RunError, match="its map is empty"):
        export(saved(NavigationBrain(), tmp_path / "new.safetensors"), tmp_path / "map.g2o")
    out = shutil.copytree(folder, tmp_path / "run")
    (out / "manifest.json").unlink()  # it would say that the file was altered
    (out / "trajectory.tum").write_text("0 1 2\n")
    with pytest.raises(SourceError, match="line 1: got 3 numbers"):
        export(out, tmp_path / "track.tum")
    assert not (tmp_path / "track.tum").exists()


def test_spiking_neurons_are_exported_and_a_brain_without_them_is_refused(chain, tmp_path):
    nir = pytest.importorskip("nir", reason="NIR is an extra")
    spiking = {"tier": "spiking", "time_step_s": 0.001, "space": {"n_rotations": 1, "n_scales": 1}}
    brain = NavigationBrain(BrainConfig(cells="pose+semantic", semantic=spiking))
    save_brain(brain, tmp_path / "spiking.safetensors")
    graph = nir.read(export(tmp_path / "spiking.safetensors", tmp_path / "walk.nir"))
    assert len(graph.nodes) == 8 * brain.semantic.slam.space.n_frequencies
    with pytest.raises(ConfigError, match="has no spiking neurons; run with semantic cells"):
        export(chain, tmp_path / "none.nir")
