"""The page on populations of one's own is run as it is printed, in a folder that was empty."""

import contextlib
import csv
import io
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from neuroslam.cli import main
from neuroslam.config import populations
from neuroslam.state import mergeable
from neuroslam.state.population import Population

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "own_population.md").read_text()
FILE, *PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [
    line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()
]


def started(*words, cwd):
    """Start a process as a user does: nothing of this one is known to it."""
    here = {k: v for k, v in os.environ.items() if k != "NEUROSLAM_PLUGINS"}
    done = subprocess.run(
        [sys.executable, *words], cwd=cwd, capture_output=True, text=True, check=False,
        env=here | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"},
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder after all commands of the page, and what each printed."""
    folder, printed = tmp_path_factory.mktemp("empty"), {}
    (folder / "visits.py").write_text(FILE)
    for line in COMMANDS:
        program, *words = shlex.split(line)
        assert program == "neuroslam"
        with forgetful(folder), contextlib.redirect_stdout(io.StringIO()) as out:
            code = main(words)
        assert code == 0, f"{line}\n{out.getvalue()}"
        printed[" ".join(words[:2])] = out.getvalue()
    return folder, printed


@contextlib.contextmanager
def forgetful(folder):
    """Be in a folder, and forget afterwards what was loaded, as if a process had ended."""
    before = dict(populations.registered)
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setenv("COLUMNS", "200")
        patched.setenv(populations.PLUGINS, "")
        patched.setattr(populations, "_loaded", {})
        yield
    for kind in populations.registered.keys() - before.keys() - populations.HOMES.keys():
        del populations.registered[kind]
    sys.modules.pop("neuroslam_plugin_visits", None)


def visits(folder):
    with (folder / "visits.csv").open(newline="") as file:
        return [int(row["visits"]) for row in csv.DictReader(file)]


def test_each_session_counts_and_a_merge_adds_up(home):
    folder, printed = home
    monday, wednesday, both = (visits(folder / n) for n in ("monday", "wednesday", "both"))
    assert min(monday) > 0
    assert len(monday) < len(both) < len(monday) + len(wednesday)
    assert sum(both) == sum(monday) + sum(wednesday)
    assert f"visits: {sum(monday)} + {sum(wednesday)} -> {sum(both)}" in printed["merge monday"]
    assert "both: sound" in printed["verify both"]


def test_a_session_on_a_stored_map_adds_to_it(home):
    folder, _ = home
    monday, tuesday = (visits(folder / n) for n in ("monday", "tuesday"))
    assert sum(tuesday) > sum(monday)
    assert all(new >= old for new, old in zip(tuesday, monday, strict=False))


def test_inspect_lists_its_counts(home):
    folder, printed = home
    assert re.search(r"visits\s+│ \d+", printed["inspect monday"])
    assert "pose+visits" in printed["inspect monday"]
    assert tomllib.loads((folder / "monday" / "config.toml").read_text())["visits"] == {
        "away_s": 1.0
    }


def test_pictures_curves_and_the_report_are_there(home):
    folder, _ = home
    assert (folder / "both" / "visits_of_each_view.png").is_file()
    page = (folder / "both" / "report.html").read_text()
    assert '"kind":"visits"' in page
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "monday" / "events"))
    events.Reload()
    assert events.Scalars("visits/visits")[-1].value > events.Scalars("visits/visits")[0].value
    assert events.Images("visits/of_each_view")


def test_the_sweep_has_its_parameter_and_its_counts(home):
    folder, _ = home
    with (folder / "compared" / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["visits.away_s"] for row in rows] == ["0.1", "10"]
    assert [row["error"] for row in rows] == ["", ""]
    assert int(rows[0]["visits"]) >= int(rows[1]["visits"]) > 0


def test_without_the_file_a_command_says_that_it_needs_it(home):
    done = started("-m", "neuroslam.cli", "inspect", "monday", cwd=home[0])
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "unknown population 'visits'" in done.stderr
    assert "--plugin FILE" in done.stderr


def test_the_program_of_the_page_prints_what_was_counted(home):
    (program,) = PROGRAMS
    done = started("-c", program, cwd=home[0])
    assert done.returncode == 0, done.stderr
    columns, *table, counts = filter(None, done.stdout.splitlines())
    assert columns == "view,visits"
    assert len(table) > 5
    total = sum(int(row.partition(",")[2]) for row in table)
    assert f"'visits': tensor({total})" in counts


def test_the_entry_point_of_the_page_is_the_one_that_is_looked_for():
    (text,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert tomllib.loads(text)["project"]["entry-points"] == {
        populations.ENTRY_POINTS: {"visits": "my_package.visits:Visits"}
    }


def test_the_page_has_every_hook_and_every_rule():
    hooks = [name for name in vars(Population) if name[0] != "_"]
    internal = {"frames", "moved_cells", "lost", "kind", "merge_rules", "relaxes_map", "rank",
                "config_section"}  # fmt: skip
    assert [name for name in hooks if f"`{name}" not in PAGE and name not in internal] == []
    rules = {
        name for name, value in vars(mergeable).items()
        if getattr(value, "__annotations__", {}).keys() == {"loaded", "partial", "join", "return"}
        and name[0] != "_"
    }  # fmt: skip
    assert len(rules) == 8
    assert [name for name in rules if f"`{name}`" not in PAGE] == []
