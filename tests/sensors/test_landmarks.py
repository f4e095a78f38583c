"""Words of landmarks: files that are read, and what is refused."""

import pytest

from neuroslam.errors import SourceError
from neuroslam.sensors.landmarks import LandmarkWords, products, read_landmarks

TABLE = (
    LandmarkWords("DOOR", "BLUE * SQUARE + TALL", number=7),
    LandmarkWords("POST", number=2),
    LandmarkWords("FENCE", "GREY * WALL", "wall", corners=(7, 2)),
    LandmarkWords("HALL", "", "region", corners=(7, 2, 9)),
)
CSV = """kind,number,name,words,corners
landmark,7,DOOR,BLUE * SQUARE + TALL,
,2,POST,,
wall,,FENCE,GREY * WALL,7 2
region,,HALL,,7 2 9
"""
TOML = """
[[landmark]]
number = 7
name = "DOOR"
words = "BLUE * SQUARE + TALL"
[[landmark]]
number = 2
name = "POST"
[[wall]]
name = "FENCE"
words = "GREY * WALL"
corners = [7, 2]
[[region]]
name = "HALL"
corners = [7, 2, 9]
"""


@pytest.mark.parametrize(("name", "text"), [("a.csv", CSV), ("b.CSV", CSV), ("c.toml", TOML)])
def test_a_table_of_words_is_read_from_csv_and_toml(name, text, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    assert read_landmarks(path) == TABLE


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "columns none; expected name"),
        ("a.csv", "number,name\n", "has no entries"),
        ("a.csv", "number,colour\n1,BLUE\n", "columns number, colour; expected name"),
        ("a.csv", "number,name,words\n1,DOOR,BLUE, TALL\n", "line 2 has more values"),
        ("a.csv", "number,name\n1,DOOR\n1,POST\n", "number 1 occurs twice"),
        ("a.csv", "number,name\n1,DOOR\n2,door\n", "door: occurs twice"),
        ("a.csv", "number,name\n1,landmark_3\n", "choose another"),
        ("a.csv", "number,name\none,DOOR\n", "expected whole numbers"),
        ("a.csv", "number,name\n-1,DOOR\n", "a landmark has a number of 0 or more"),
        ("a.csv", "number,name\n1,BIG DOOR\n", "'BIG DOOR' is no name"),
        ("a.csv", "number,name,words\n1,DOOR,BLUE - RED\n", "DOOR: cannot read the words"),
        (
            "a.csv",
            f"number,name,words\n1,DOOR,{'A + ' * 50}A\n",
            "bytes of words; expected at most",
        ),
        ("a.csv", "kind,name,corners\nwall,FENCE,1\n", "a wall has 2 to 16 numbers"),
        ("a.csv", "kind,name,corners\nregion,HALL,1 2\n", "a region has 3 to 16 numbers"),
        ("a.csv", "kind,name\ntree,OAK\n", "is a 'tree'; expected landmark, wall, region"),
        ("a.toml", "[[landmark]\n", "is not TOML"),
        ("a.toml", "[[tree]]\nname = 'OAK'\n", "has 'tree'; expected tables"),
        ("a.toml", "[[landmark]]\ncolour = 'BLUE'\n", "landmark 0: has colour; expected number"),
        ("a.toml", "[[wall]]\nname = 'W'\ncorners = 3\n", "corners 3; expected whole numbers"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(name, text, message, tmp_path):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SourceError, match=message) as error:
        read_landmarks(path)
    assert "\n" not in str(error.value)


def test_a_table_that_is_missing_is_refused(tmp_path):
    with pytest.raises(SourceError, match="no such file; expected a table of landmarks"):
        read_landmarks(tmp_path / "none.csv")


@pytest.mark.parametrize("text", ["", "BLUE SQUARE", "BLUE ** 2", "f(BLUE)", "2 * BLUE", "(" * 300])
def test_only_words_products_and_sums_are_expressions(text):
    with pytest.raises(SourceError, match="cannot read the words"):
        products(text)
