"""Rules of merging: sums are conserved, and the order of merging matters only where it should."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.errors import MapError
from neuroslam.state.join import Join
from neuroslam.state.mergeable import (
    about_now,
    experience_id,
    merge_by_rules,
    rows_of_experiences,
    rows_of_views,
    summed,
    summed_by_experience,
    summed_by_view,
    view_id,
)

THINGS = 12  # that there are in the world


class Session(NamedTuple):
    """Which things a session knows, by its own numbers, and a sum for each."""

    things: list[int]
    sums: torch.Tensor


@st.composite
def sessions(draw, least=0):
    things = draw(
        st.lists(st.integers(0, THINGS - 1), unique=True, min_size=least, max_size=THINGS)
    )
    sums = draw(st.lists(st.integers(0, 1000), min_size=len(things), max_size=len(things)))
    return Session(things, torch.tensor(sums, dtype=torch.int64))


def join_of(loaded, partial):
    """How ids change where equal things become one, by views and by experiences alike."""
    new = [thing for thing in partial.things if thing not in loaded.things]
    known = loaded.things + new
    ids = np.array([known.index(thing) for thing in partial.things], dtype=np.int64)
    n = len(loaded.things)
    return Join.nothing()._replace(views=ids, experiences=ids, n_views=n, n_experiences=n), known


def merged(rule, loaded, partial):
    join, known = join_of(loaded, partial)
    return Session(known, rule(loaded.sums, partial.sums, join))


BY_ID = [summed_by_view, summed_by_experience]
ROWS = [rows_of_views, rows_of_experiences]
few = settings(max_examples=60, deadline=None)


@pytest.mark.parametrize("rule", BY_ID)
@few
@given(sessions(), sessions())
def test_sums_are_conserved_of_each_thing_and_in_all(rule, loaded, partial):
    both = merged(rule, loaded, partial)
    assert both.sums.sum() == loaded.sums.sum() + partial.sums.sum()
    for thing, total in zip(both.things, both.sums.tolist(), strict=True):
        assert total == sum(
            one.sums[one.things.index(thing)].item()
            for one in (loaded, partial)
            if thing in one.things
        )


@pytest.mark.parametrize("rule", [*BY_ID, *ROWS])
@few
@given(sessions(), sessions(), sessions())
def test_it_does_not_matter_which_two_are_merged_first(rule, a, b, c):
    left = merged(rule, merged(rule, a, b), c)
    right = merged(rule, a, merged(rule, b, c))
    assert left.things == right.things
    assert torch.equal(left.sums, right.sums)


@few
@given(sessions(), sessions())
def test_sums_do_not_depend_on_which_session_goes_on(a, b):
    one, other = merged(summed_by_view, a, b), merged(summed_by_view, b, a)
    assert dict(zip(one.things, one.sums.tolist(), strict=True)) == dict(
        zip(other.things, other.sums.tolist(), strict=True)
    )


@pytest.mark.parametrize("rule", [*BY_ID, *ROWS])
@few
@given(sessions())
def test_a_session_without_experience_changes_nothing(rule, session):
    nothing = Session([], torch.zeros(0, dtype=torch.int64))
    for both in (merged(rule, nothing, session), merged(rule, session, nothing)):
        assert both.things == session.things
        assert torch.equal(both.sums, session.sums)


@pytest.mark.parametrize("rule", ROWS)
@few
@given(sessions(), sessions())
def test_rows_keep_what_the_loaded_session_knew_and_add_what_is_new(rule, loaded, partial):
    both = merged(rule, loaded, partial)
    assert torch.equal(both.sums[: len(loaded.sums)], loaded.sums)
    new = [i for i, thing in enumerate(partial.things) if thing not in loaded.things]
    assert torch.equal(both.sums[len(loaded.sums) :], partial.sums[new])


@pytest.mark.parametrize("rule", BY_ID)
@few
@given(sessions(least=1), sessions(least=1), st.data())
def test_tables_that_end_at_the_last_seen_row_are_summed_too(rule, loaded, partial, data):
    join, _ = join_of(loaded, partial)
    short = [one.sums[: data.draw(st.integers(0, len(one.sums)))] for one in (loaded, partial)]
    full = [
        torch.nn.functional.pad(part, (0, len(one.sums) - len(part)))
        for part, one in zip(short, (loaded, partial), strict=True)
    ]
    result, expected = rule(*short, join), rule(*full, join)
    assert torch.equal(result, expected[: len(result)])
    assert not expected[len(result) :].any()


@pytest.mark.parametrize(("rule", "what"), list(zip(ROWS, ["views", "experiences"], strict=True)))
def test_rows_that_would_go_to_others_are_refused(rule, what):
    join = Join.nothing()._replace(
        views=np.array([0, 3]), experiences=np.array([0, 3]), n_views=3, n_experiences=3
    )
    three, two = torch.arange(3), torch.arange(2)
    assert rule(three, two, join).tolist() == [0, 1, 2, 1]
    with pytest.raises(
        MapError, match=f"loaded table has 2 rows, expected one for each of 3 {what}"
    ):
        rule(two, two, join)
    with pytest.raises(
        MapError, match=f"partial table has 3 rows, expected one for each of 2 {what}"
    ):
        rule(three, three, join)


@pytest.mark.parametrize("rule", [view_id, experience_id])
@few
@given(sessions(), sessions(least=1), sessions(), st.data())
def test_an_id_names_the_same_thing_after_any_merges(rule, a, b, c, data):
    number = data.draw(st.integers(0, len(b.things) - 1))
    join, known = join_of(a, b)
    once = rule(torch.tensor(0), torch.tensor(number), join)
    assert known[int(once)] == b.things[number]
    again, known = join_of(c, Session(known, torch.zeros(len(known))))
    assert known[int(rule(torch.tensor(0), once, again))] == b.things[number]
    assert rule(torch.tensor(0), torch.tensor(-1), join) == -1


@few
@given(st.lists(st.integers(-1000, 1000), min_size=9, max_size=9))
def test_sums_of_one_shape_add_in_any_order(numbers):
    a, b, c = torch.tensor(numbers).reshape(3, 3)
    join = Join.nothing()
    left, right = summed(summed(a, b, join), c, join), summed(a, summed(b, c, join), join)
    assert torch.equal(left, right)
    assert left.sum() == sum(numbers)
    assert torch.equal(summed(torch.zeros_like(a), a, join), a)


def test_about_now_is_that_of_the_session_that_goes_on():
    assert about_now(torch.tensor(1), torch.tensor(2), Join.nothing()) == 2


def test_neither_state_is_altered_and_what_has_no_rule_is_named():
    join = Join.nothing()._replace(views=np.array([1]), n_views=1)
    loaded = {"seen": torch.tensor([5]), "table.x": torch.tensor([1])}
    partial = {"seen": torch.tensor([7]), "table.x": torch.tensor([2])}
    before = [{n: v.clone() for n, v in state.items()} for state in (loaded, partial)]
    rules = {"seen": summed_by_view, "table": rows_of_views}
    result = merge_by_rules(rules, loaded, partial, join)
    assert {name: value.tolist() for name, value in result.items()} == {
        "seen": [5, 7], "table.x": [1, 2]
    }  # fmt: skip
    for state, was in zip((loaded, partial), before, strict=True):
        assert all(torch.equal(state[name], was[name]) for name in was)
    with pytest.raises(MapError, match=r"table\.x has no rule; add it to merge_rules"):
        merge_by_rules({"seen": summed_by_view}, loaded, partial, join)
