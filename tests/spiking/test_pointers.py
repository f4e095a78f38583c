"""Names as vectors, and what is said with them."""

import pytest
import torch

from neuroslam.errors import SpaceError
from neuroslam.spiking.algebra import bind
from neuroslam.spiking.pointers import SemanticPointers

WORDS = SemanticPointers(["BLUE", "RED", "SQUARE", "TRIANGLE"], 151)


def test_expressions_bind_add_and_invert():
    said = WORDS.parse("BLUE * (SQUARE + TRIANGLE)")
    meant = bind(WORDS["BLUE"], WORDS["SQUARE"] + WORDS["TRIANGLE"])
    torch.testing.assert_close(said, meant)
    torch.testing.assert_close(WORDS.parse("BLUE * ~BLUE * RED"), WORDS["RED"], atol=1e-5, rtol=0)


def test_structures_are_taken_apart_again():
    thing = WORDS.parse("BLUE * SQUARE + RED * TRIANGLE")
    assert WORDS.decode(bind(thing, WORDS.parse("~BLUE"))) == "SQUARE"
    assert WORDS.decode(bind(thing, WORDS.parse("~TRIANGLE"))) == "RED"


def test_noise_is_cleaned_up():
    draw = torch.Generator().manual_seed(0)
    noisy = WORDS.vectors + 0.5 / 151**0.5 * torch.randn(4, 151, generator=draw)
    assert torch.equal(WORDS.clean_up(noisy), WORDS.vectors)


@pytest.mark.parametrize("how", ["unitary", "orthogonal", "random"])
def test_vectors_are_of_length_one_and_follow_from_the_seed(how):
    made = [SemanticPointers(["A", "B", "C"], 55, s, how).vectors for s in (3, 3, 4)]
    torch.testing.assert_close(made[0].norm(dim=-1), torch.ones(3))
    assert torch.equal(made[0], made[1])
    assert not torch.equal(made[0], made[2])


def test_orthogonal_ones_do_not_interfere():
    vectors = SemanticPointers([f"L{k}" for k in range(20)], 55, how="orthogonal").vectors
    torch.testing.assert_close(vectors @ vectors.T, torch.eye(20), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("BLU", "there is BLUE"),
        ("BLUE +", "cannot read 'BLUE \\+'"),
        ("__import__('os')", "cannot read"),
        ("BLUE ** RED", "cannot read"),
        ("", "cannot read"),
    ],
)
def test_what_cannot_be_read_is_refused(expression, said):
    with pytest.raises(SpaceError, match=said):
        WORDS.parse(expression)


def test_impossible_vocabularies_are_refused():
    with pytest.raises(SpaceError, match="different words"):
        SemanticPointers(["A", "A"], 5)
    with pytest.raises(SpaceError, match="BLUE SKY"):
        SemanticPointers(["BLUE SKY"], 5)
    with pytest.raises(SpaceError, match="6 orthogonal vectors"):
        SemanticPointers(list("ABCDEF"), 5, how="orthogonal")
    with pytest.raises(SpaceError, match="the vocabulary has 151"):
        WORDS.similarity(torch.zeros(3))
