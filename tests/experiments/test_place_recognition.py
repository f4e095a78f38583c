"""Place recognition on a second walk: how the recordings are read, and what is found there."""

import json
import tarfile

import cv2
import numpy as np
import pytest

from neuroslam import open_source
from neuroslam.config import ViewConfig
from neuroslam.errors import SourceError
from neuroslam.experiments import place_recognition as experiment
from neuroslam.experiments import run_experiment

GRADIENTS = ViewConfig(**experiment.KINDS["gradients, 16 x 12 x 6"])


@pytest.fixture(scope="module")
def walks():
    """A rendered corridor, walked again with less light."""
    first, second = (
        [
            frame.image
            for frame in open_source(f"world:corridor?frames_per_lap=60&grey=true{more}").frames(
                0, 30
            )
        ]
        for more in ("", "&gain=0.6&people=4")
    )
    return experiment.Walks(first, second, np.eye(30, dtype=bool))


def test_a_walk_is_recognised_in_other_light(walks):
    found = experiment.match_walks(walks, GRADIENTS)
    assert (found.single == np.arange(30)).mean() > 0.9
    assert (found.sequence == np.arange(30)).mean() > 0.9
    assert 0.0 < found.single_ms < found.sequence_ms


def test_queries_that_are_drawn_at_random_are_recognised_by_chance_only(walks):
    drawn = np.random.default_rng(0).permutation(30)
    mixed = walks._replace(queries=[walks.queries[i] for i in drawn], same=walks.same[drawn])
    found = experiment.match_walks(mixed, GRADIENTS)
    assert (found.single == drawn).mean() > 0.9  # alone a frame does not depend on the others
    assert (found.sequence == drawn).mean() < 0.5


def write_vpr(folder, walks):
    for name, images in (("query", walks.queries), ("ref", walks.references)):
        (folder / name).mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(folder / name / f"{number:07d}.png"), image)
    truth = {str(q): np.flatnonzero(row).tolist() for q, row in enumerate(walks.same)}
    (folder / "truth.json").write_text(json.dumps(truth))


def test_vpr_corridor_is_read_from_its_tar_and_drawn_beside_published_methods(
    walks, tmp_path, monkeypatch
):
    write_vpr(tmp_path, walks)
    with tarfile.open(tmp_path / "images.tar", "w") as tar:
        for name in ("ref", "query"):
            tar.add(tmp_path / name, arcname=name)
    read = experiment.read_vpr_corridor(tmp_path)
    assert np.array_equal(read.same, walks.same)
    assert np.array_equal(read.queries[7], walks.queries[7])
    assert np.array_equal(read.references[7], walks.references[7])
    kinds = {name: experiment.KINDS[name] for name in list(experiment.KINDS)[:1]}
    monkeypatch.setattr(experiment, "KINDS", kinds)
    result = experiment.vpr_corridor(tmp_path, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == result
    assert [row["frames"] for row in result["rows"]] == [1, 10, 1, 10]
    assert [row["recall_at_1"] for row in result["rows"][2:]] == [1.0, 1.0]  # by regions
    assert result["published"]["NetVLAD"]["recall_at_1"] == 0.676
    assert (tmp_path / "out" / "pr_curves.png").stat().st_size > 10_000
    (tmp_path / "truth.json").write_text('{"0": [99]}')
    with pytest.raises(SourceError, match=r"1 queries, but images\.tar has 60"):
        experiment.read_vpr_corridor(tmp_path)
    (tmp_path / "truth.json").write_text("[]")
    with pytest.raises(SourceError, match="cannot be read; expected query"):
        experiment.read_vpr_corridor(tmp_path)


def test_gradients_and_sequences_recognise_a_real_corridor_better(shared, tmp_path):
    rows = run_experiment("rtabmap-corridor", shared / "data", tmp_path)
    recall = {(row["templates"], row["frames"]): row["recall_at_1"] for row in rows}
    default, gradients = "grey, 60 x 10, the default", "gradients, 16 x 12 x 6"
    assert recall[gradients, 1] > recall[default, 1] + 0.2
    assert recall[default, 10] > recall[default, 1] + 0.2
    assert recall[gradients, 10] > 0.95
    assert recall[experiment.REGIONS, 1] > 0.95
    assert recall[experiment.REGIONS, 10] == 1.0
    assert all(row["ms_per_frame"] > 0 for row in rows)


def test_regions_recognise_a_corridor_from_beside_and_in_other_light(shared):
    if not (shared / "data" / "vpr_corridor").is_dir():
        pytest.skip("no vpr_corridor beside the checkout")
    walks = experiment.read_vpr_corridor(shared / "data" / "vpr_corridor")
    assert walks.same.shape == (111, 111)
    assert walks.same.any(axis=1).all()
    assert walks.queries[0].shape[:2] == (120, 160)
    found = experiment.match_regions(walks)
    recall = [walks.same[np.arange(111), at].mean() for at in (found.single, found.sequence)]
    assert recall[0] > 0.6
    assert recall[1] > 0.9
