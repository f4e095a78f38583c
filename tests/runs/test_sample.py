"""Sample videos: two days of the same corridor, as the page of the first ten minutes makes them."""

import re
from pathlib import Path

import numpy as np
import pytest

from neuroslam.errors import RunError
from neuroslam.runs import sample
from neuroslam.sensors import open_source

PAGE = Path(__file__).resolve().parents[2] / "docs" / "first_ten_minutes.md"


def test_a_sample_is_read_as_a_video_with_its_pictures_and_times(tmp_path):
    assert sample.write_sample(tmp_path / "day.mp4", stop=8) == 8
    read = list(open_source(tmp_path / "day.mp4").frames())
    drawn = list(open_source(f"{sample.DAYS[1]}&grey=true").frames(stop=8))  # as videos are read
    assert [frame.time_s for frame in read] == pytest.approx([frame.time_s for frame in drawn])
    for one, other in zip(read, drawn, strict=True):
        error = np.abs(one.image.astype(int) - other.image.astype(int)).mean()
        assert error < 8.0, "compression changes a pixel by a few of 255"


def test_the_days_start_at_different_places(tmp_path):
    first, second = (
        next(iter(open_source(sample.DAYS[day]).frames(stop=1))).truth for day in (1, 2)
    )
    assert np.hypot(first.x_m - second.x_m, first.y_m - second.y_m) > 5.0


def test_the_line_of_the_page_writes_both_days(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = {
        day: re.sub(r"laps=[\d.]+", "laps=0.02", source) for day, source in sample.DAYS.items()
    }
    monkeypatch.setattr(sample, "DAYS", short)
    (line,) = re.findall(r"^python -c '(.+)'$", PAGE.read_text("utf-8"), re.MULTILINE)
    exec(line, {})
    assert {path.name for path in tmp_path.iterdir()} == {"monday.mp4", "tuesday.mp4"}


@pytest.mark.parametrize(
    ("name", "day", "text"),
    [
        ("day.mp4", 3, "expected 1 or 2"),
        ("day.gif", 1, "ends in .mp4 or .avi"),
        ("missing/day.avi", 1, "does its folder exist"),
    ],
)
def test_mistakes_are_named(tmp_path, name, day, text):
    with pytest.raises(RunError, match=text):
        sample.write_sample(tmp_path / name, day)
