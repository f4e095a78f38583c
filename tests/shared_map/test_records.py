"""The set of offers: equal whatever the order of arrival, and however often an offer came."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.shared_map.records import Records
from tests.shared_map.test_messages import offer


def parts(n_robots=3, n=9, size=3):
    """Offers of robots, each a few places and the links that lead to them."""
    found = []
    for robot in range(n_robots):
        whole = offer(n, seed=robot, session=100 + robot)
        for at in range(0, n, size):
            links = whole.links[(whole.links["target"] >= at) & (whole.links["target"] < at + size)]
            found.append(
                (
                    f"r{robot}",
                    whole._replace(
                        pixels=whole.pixels[at : at + size],
                        places=whole.places[at : at + size],
                        links=links,
                    ),
                )
            )
    return found


OFFERS = parts()
"""Two of them contradict a third: they are added below."""


def contradiction():
    name, one = OFFERS[1]
    places = one.places.copy()
    places["pose"][0] += 1.0
    return name, one._replace(places=places)


def set_of(offers):
    records = Records()
    for robot, one in offers:
        records.add(robot, one)
    return records


@settings(max_examples=60, deadline=None)
@given(
    st.permutations([*OFFERS, contradiction()]),
    st.lists(st.integers(0, len(OFFERS)), max_size=6),
)
def test_the_set_does_not_depend_on_order_or_repetition(order, again):
    whole = [*OFFERS, contradiction()]
    one, other = set_of(whole), set_of([*order, *(whole[k] for k in again)])
    assert one.digest() == other.digest()
    assert one.pieces() == other.pieces()


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(0, len(OFFERS) - 1)))
def test_joining_two_sets_is_adding_all_offers_of_both(some):
    first = [OFFERS[k] for k in sorted(some)]
    assert set_of(OFFERS).digest() == set_of([*first, *OFFERS]).digest()


def test_what_is_missing_leaves_pieces_that_become_one_when_it_comes():
    missing = [one for k, one in enumerate(OFFERS) if k != 1]
    records = set_of(missing)
    assert [len(p.keys) for p in records.pieces() if p.robot == "r0"] == [3, 3]
    records.add(*OFFERS[1])
    assert [len(p.keys) for p in records.pieces()] == [9, 9, 9]


def test_two_places_of_one_number_put_a_session_in_quarantine():
    assert all(not piece.fault for piece in set_of(OFFERS).pieces())
    faults = [p.fault for p in set_of([*OFFERS, contradiction()]).pieces() if p.fault]
    assert len(faults) == 1
    assert "0000000064" in faults[0]


def test_a_place_whose_view_has_not_come_waits():
    name, one = OFFERS[0]
    blind = one._replace(pixels=np.zeros((0, 12), np.uint8))
    assert set_of([(name, blind)]).pieces() == []
    assert len(set_of([(name, blind), (name, one)]).pieces()) == 1
