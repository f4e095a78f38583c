"""Semantic maps that are asked: names, places and pointers that grow together; answers."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam import cli
from neuroslam.config.semantic import SemanticConfig, SSPSLAMConfig
from neuroslam.errors import SpaceError
from neuroslam.experiments.semantic_maps import CELLS, STAGES, Trial, score
from neuroslam.runs.ask import AskedMap
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.spiking import (
    SSPSLAM,
    load_semantic_map,
    merge_semantic_maps,
    queries,
    save_semantic_map,
)
from neuroslam.spiking.ask import EXAMPLES, ask, contents, parse_question
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.semantic_joining import merge_landmarks
from neuroslam.spiking.sightings import Sightings
from neuroslam.state.join import Join
from neuroslam.types import Motion

STILL = Motion(0.0, 0.0, 0.1)
WORDS = (
    LandmarkWords("DOOR", "BLUE * SQUARE", number=0),
    LandmarkWords("LAMP", "RED * SQUARE + TALL", number=1),
    LandmarkWords("DESK", "BLUE * TRIANGLE", number=2),
    LandmarkWords("FENCE", "GREY * HEDGE", "wall", corners=(0, 1)),
    LandmarkWords("HALL", "GREEN * ROOM", "region", corners=(0, 1, 2, 3)),
    LandmarkWords("YARD", "", "region", corners=(0, 1, 9)),
    LandmarkWords("GHOST", "WHITE", number=8),
)


def ring(n=4, radius=2.0):
    return np.array([(k, radius, 2.0 * math.pi * k / n) for k in range(n)])


def taught(words=WORDS, **config):
    """Cells that stand still among four landmarks: 0 to the east, 1 north, 2 west, 3 south."""
    cells = SemanticCells(SemanticConfig(**config))
    cells.name_landmarks(words)
    for _ in range(80):
        cells.advance(STILL, Sightings.of(ring()))
    return cells


@pytest.fixture(scope="module")
def room():
    return taught()


# --- growth ------------------------------------------------------------------------------------

SIGHTS = st.lists(
    st.lists(
        st.tuples(st.integers(-1, 9), st.floats(0.5, 6.0), st.floats(-3.0, 3.0)),
        max_size=4,
        unique_by=lambda row: row[0],
    ),
    min_size=1,
    max_size=12,
)


@pytest.mark.parametrize("places", [False, True])
@settings(max_examples=15, deadline=None, derandomize=True)
@given(sights=SIGHTS, named=st.sets(st.integers(0, 9)), when=st.integers(0, 12))
def test_pointers_names_and_both_memories_grow_together(places, sights, named, when):
    cells = SemanticCells(SemanticConfig(places=places))
    words = [LandmarkWords(f"L{k}", number=k) for k in sorted(named)]
    for i, rows in enumerate(sights):
        if i == when:
            cells.name_landmarks(words)
        for _ in range(4):
            cells.advance(STILL, Sightings.of(np.array(rows).reshape(-1, 3)))
        n = max(1, len(cells.known))
        assert len(cells.slam.names) == len(cells.slam.pointers) == n
        if len(cells.known):
            assert list(cells.slam.names) == cells.names()
        if places:
            assert tuple(queries.what(cells.slam, (-1.0, -1.0), (1.0, 1.0))) == cells.slam.names
        again = SemanticCells(cells.config)
        again.load_state_dict(cells.state_dict())
        assert again.slam.names == cells.slam.names or not len(cells.known)
        torch.testing.assert_close(again.slam.pointers, cells.slam.pointers)
    if when < len(sights):
        expected = {f"L{k}" if k in named else f"landmark_{k}" for k in range(10)}
        assert {name for name in cells.names() if not name.startswith("nameless")} <= expected


@pytest.mark.parametrize("places", [False, True])
def test_an_area_of_a_growing_map_has_its_landmarks_under_their_names(places):
    cells = taught(places=places)
    assert set(queries.landmarks_in(cells.slam, (1.0, -1.0), (3.0, 1.0))) == {"DOOR"}
    assert set(queries.landmarks_in(cells.slam, (-3.0, -3.0), (3.0, 3.0))) == {
        "DOOR", "LAMP", "DESK", "landmark_3",
    }  # fmt: skip
    if places:
        amounts = queries.what(cells.slam, (1.5, -0.5), (2.5, 0.5))
        assert max(amounts, key=amounts.__getitem__) == "DOOR"


def test_pointers_and_names_cannot_be_of_different_number():
    cells = taught()
    with pytest.raises(SpaceError, match="1 names for 4 pointers"):
        cells.slam.know(cells.slam.pointers, ["ONE"])
    with pytest.raises(AttributeError):
        cells.slam.names = ("ONE",)


def test_words_do_not_change_what_is_learnt():
    plain, named = taught(()).state_dict(), taught().state_dict()
    assert {key.split(".")[0] for key in named.keys() - plain.keys()} == {"words"}
    for key, value in plain.items():
        assert torch.equal(value, named[key]), key


# --- answers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("question", "names"),
    [
        ("what is at 2,0", ["DOOR", "FENCE", "HALL"]),
        ("What is at 1, 1?", ["FENCE", "HALL"]),
        ("what's at 9 9", []),
        ("what is in 1,-1,3,1", ["DOOR", "FENCE", "HALL"]),
        ("what is in the box -3,-0.5, -1.9,0.5", ["DESK", "HALL"]),
        ("what is in 5,5,6,6", []),
        ("where is door", ["DOOR"]),
        ("where is the fence", ["FENCE"]),
        ("where is landmark_3", ["landmark_3"]),
        ("where is BLUE * (SQUARE + TRIANGLE)", ["DOOR", "DESK"]),
        ("where is TALL * SQUARE", []),
        ("which landmarks are blue", ["DOOR", "DESK"]),
        ("which are tall squares", ["LAMP"]),
        ("which are walls", ["FENCE"]),
        ("which are green rooms", ["HALL"]),
        ("which are white", []),
        ("the whole map", ["DOOR", "LAMP", "DESK", "landmark_3", "FENCE", "HALL"]),
    ],
)
def test_questions_are_answered_with_names(room, question, names):
    answer = ask(room, question)
    assert [one.name for one in answer.found] == names
    assert bool(answer.note) != bool(names)


def test_positions_are_those_that_the_memory_recalls(room):
    found = {one.name: one.position_m for one in ask(room, "map").found}
    np.testing.assert_allclose(found["DOOR"], (2.0, 0.0), atol=0.05)
    np.testing.assert_allclose(found["LAMP"], (0.0, 2.0), atol=0.05)
    np.testing.assert_allclose(found["FENCE"], (1.0, 1.0), atol=0.05)
    empty = SemanticCells(room.config)
    empty.load_state_dict(room.state_dict())
    empty.slam.map.weights = torch.zeros_like(empty.slam.map.weights)
    assert ask(empty, "map").found == ()  # a table of positions alone answers nothing


def test_the_answer_to_a_box_has_the_share_that_is_in_it(room):
    shares = {one.name: one.share for one in ask(room, "what is in 1,-0.2,3,3").found}
    # Of the square's 8 m2 there are 0.5 above the x axis, 0.18 below it.
    assert shares == pytest.approx({"DOOR": 1.0, "FENCE": 0.5, "HALL": 0.085}, abs=0.03)


@pytest.mark.parametrize(
    ("question", "message"),
    [
        ("", "cannot read ''; ask, for example: what is at 2,1; "),
        ("what is at 2", "cannot read 'what is at 2'; ask, for example"),
        ("what is in 1,1,0,0", "the lower corner first; got 1, 1, 0, 0"),
        ("what is at 1e999,0", "a coordinate is not a finite number"),
        ("where is waldo", "the map knows no name or word WALDO"),
        ("which are bleu", "no name or word BLEU; did you mean 'BLUE'"),
        ("where is BLUE ** 2", "cannot read the words"),
    ],
)
def test_a_question_that_cannot_be_answered_is_refused_in_one_line(room, question, message):
    with pytest.raises(SpaceError, match=message.replace("*", r"\*")) as error:
        ask(room, question)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("question", "note"),
    [
        ("where is ghost", "GHOST was not seen"),
        ("where is yard", "YARD has corners that were not seen: 9"),
        ("what is at 9,9", "nothing is within 1 m of 9,9; the nearest is "),
    ],
)
def test_what_is_not_known_is_said(room, question, note):
    assert ask(room, question).note.startswith(note)


def test_every_example_of_the_grammar_is_in_it():
    assert [parse_question(example).form for example in EXAMPLES] == [
        "at", "box", "where", "which", "map",
    ]  # fmt: skip


def merged_cells(loaded, partial):
    states = loaded.state_dict(), partial.state_dict()
    merged = SemanticCells(SemanticConfig())
    merged.load_state_dict(
        merge_landmarks(lambda: SemanticCells(SemanticConfig()), *states, Join.nothing())
    )
    return merged


def test_a_merge_keeps_the_words_of_both_and_the_later_ones_hold():
    later = LandmarkWords("GATE", "RED", number=0)
    one, other = taught(), taught([later, LandmarkWords("TREE", "GREEN", number=3)])
    merged = merged_cells(one, other)
    names = [one.name for one in contents(merged).found]
    assert names == ["GATE", "LAMP", "DESK", "TREE", "FENCE", "HALL"]
    assert merged.slam.names == ("GATE", "LAMP", "DESK", "TREE")


def test_an_outlier_of_a_later_session_does_not_move_a_landmark_in_a_merge():
    one, other = taught(), SemanticCells(SemanticConfig())
    other.advance(STILL, Sightings.of(np.array([[0.0, 5.0, math.pi]])))
    merged = merged_cells(one, other)
    np.testing.assert_allclose(ask(merged, "where is door").found[0].position_m, (2, 0), atol=0.05)


def test_one_outlier_of_a_known_landmark_does_not_end_the_learning_of_new_ones():
    cells = SemanticCells(SemanticConfig())
    cells.name_landmarks(WORDS)
    door, lamp = np.array([[0.0, 2.0, 0.0]]), np.array([[1.0, 2.0, math.pi / 2.0]])
    outlier = np.array([[0.0, 5.0, math.pi]])
    nothing = np.empty((0, 3))
    for rows in (*[door] * 20, nothing, door, door, outlier, outlier):
        cells.advance(STILL, Sightings.of(rows), compass_rad=0.0)
    assert 0.0 < float(cells.slam.contradicted_s) < cells.config.relocalise_after_s
    for _ in range(30):
        cells.advance(STILL, Sightings.of(lamp), compass_rad=0.0)
    assert float(cells.slam.contradicted_s) == 0.0
    for name, position_m in (("lamp", (0, 2)), ("door", (2, 0))):
        found = ask(cells, f"where is {name}").found[0]
        np.testing.assert_allclose(found.position_m, position_m, atol=0.05)


# --- runs --------------------------------------------------------------------------------------


def test_the_map_of_a_run_is_asked_on_the_command_line(tmp_path, capsys):
    world = "world:corridor?width=32&height=20&markers=10&landmark_reach=6&frames_per_lap=150"
    run, picture = str(tmp_path / "run"), tmp_path / "answer.png"
    table = tmp_path / "words.csv"
    table.write_text("kind,number,name,words,corners\n,0,DOOR,OAK,\nwall,,FENCE,GREY,0 1\n")
    options = ["--set", "cells=semantic", "--stop", "60", "--no-tensorboard"]
    assert cli.main(["run", world, "-o", run, "--landmarks", str(table), *options]) == 0
    assert cli.main(["verify", run]) == 0
    capsys.readouterr()
    assert cli.main(["ask", run, "where is fence", "--json", "-o", str(picture)]) == 0
    (fence,) = json.loads(capsys.readouterr().out)["found"]
    assert (fence["kind"], fence["words"], len(fence["corners_m"])) == ("wall", "GREY", 2)
    assert picture.stat().st_size > 1000
    assert cli.main(["ask", run, "which landmarks are blue"]) == 0
    assert "BLUE * SQUARE + SMALL" in capsys.readouterr().out  # of the world
    table.write_text("number,name\n0,GATE\n")
    assert cli.main(["ask", run, "where is gate", "--landmarks", str(table)]) == 0
    assert cli.main(["ask", run, "hello"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    header, first = (tmp_path / "run/landmarks.csv").read_text().splitlines()[:2]
    assert header.endswith(",words")
    assert (first.split(",")[0], first.split(",")[-1]) == ("DOOR", "OAK")


def test_a_new_map_after_a_kidnapping_has_the_words(tmp_path):
    from neuroslam.brain import NavigationBrain, load_brain, save_brain
    from neuroslam.config import build_config
    from neuroslam.sensors import open_source

    brain = NavigationBrain(build_config({"cells": "semantic"}))
    brain.semantic.name_landmarks([LandmarkWords(f"POST{k}", number=k) for k in range(10)])
    for frame in open_source("world:corridor?width=16&height=10&markers=10&landmark_reach=6"
                             "&frames_per_lap=150").frames(0, 15):  # fmt: skip
        brain(frame)
    brain.start_new_map()
    save_brain(brain, tmp_path / "brain.safetensors")
    again = load_brain(tmp_path / "brain.safetensors")
    assert [e.name for e in again.semantic.words.entries] == [f"POST{k}" for k in range(10)]
    assert again.stored[0].semantic.words.entries == again.semantic.words.entries


def test_a_semantic_map_file_is_asked_too(tmp_path):
    slam = SSPSLAM(SSPSLAMConfig(tier="algebraic"), torch.eye(20)[:2], ["DOOR", "LAMP"])
    at = torch.tensor([[0.5, 0.2], [-0.3, 0.6]])
    slam.map.write(slam.pointers, slam.space.encode(at))
    save_semantic_map(slam, tmp_path / "map.safetensors")
    answer = AskedMap(tmp_path / "map.safetensors").ask("where is lamp")
    np.testing.assert_allclose(answer.found[0].position_m, (-0.3, 0.6), atol=1e-3)


@pytest.mark.parametrize("config", [{}, {"places": True, "sigma_distance_m": 0.1}])
def test_the_map_of_a_brain_is_written_to_a_file_of_its_own(tmp_path, config):
    cells = taught(**config)
    save_semantic_map(cells.slam, tmp_path / "map.safetensors")
    again = load_semantic_map(tmp_path / "map.safetensors")
    answer = ask(again, "where is door")
    np.testing.assert_allclose(answer.found[0].position_m, (2.0, 0.0), atol=0.05)
    assert again.names == ("DOOR", "LAMP", "DESK", "landmark_3")
    state = cells.slam.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in again.state_dict().items())
    on = [slam(torch.tensor([[0.3, 0.0]])).z for slam in (cells.slam, again)]
    assert torch.equal(*on)
    merged, report = merge_semantic_maps(again, again)
    assert report.joined
    assert merged.names == again.names


def test_the_answers_of_a_map_are_right_after_save_resume_and_merge():
    scores = score(Trial(3, CELLS[1]))
    assert tuple(scores) == STAGES
    for stage, counts in scores.items():
        assert counts["named"] == counts["landmarks"] >= 6, stage
        assert counts["areas_right"] == counts["areas"] == 4, stage
        assert counts["attributes_right"] == counts["attributes"], stage
