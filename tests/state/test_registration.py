"""Registration of populations: what is refused, and where populations may come from."""

import os
import sys
import textwrap
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import nn

from neuroslam import BrainConfig, NavigationBrain
from neuroslam.config import Section, populations
from neuroslam.errors import ConfigError
from neuroslam.runs.files import RUN_FILES
from neuroslam.runs.results import RunSummary
from neuroslam.state.answers import (
    RUN_FIGURES,
    RUN_TABLES,
    check_names,
    counts_of,
    gathered,
    pictures_of,
    scalars_of,
    tables_of,
)
from neuroslam.state.mergeable import about_now, summed
from neuroslam.state.population import Population
from neuroslam.state.registry import BRAIN_NAMES, register


@pytest.fixture(autouse=True)
def clean(monkeypatch):
    """Forget afterwards what was registered and loaded."""
    monkeypatch.setenv(populations.PLUGINS, "")
    monkeypatch.setattr(populations, "_loaded", dict(populations._loaded))
    before, modules = dict(populations.registered), set(sys.modules)
    yield
    for kind in populations.registered.keys() - before.keys() - populations.HOMES.keys():
        del populations.registered[kind]
    for name in set(sys.modules) - modules:
        if name.startswith(("neuroslam_plugin_", "acme_")):
            del sys.modules[name]


class Sum(Population):
    """Sums something up."""

    merge_rules: ClassVar = {"total": summed}

    def __init__(self):
        super().__init__()
        self.register_buffer("total", torch.tensor(0))
        self.register_buffer("many", torch.zeros(2, 2), persistent=False)


class Plain(Sum):
    pass


class WithoutRule(Sum):
    merge_rules: ClassVar = {}


class TwoWithoutRule(Sum):
    merge_rules: ClassVar = {}

    def __init__(self):
        super().__init__()
        self.inner = nn.Linear(1, 1)


class Forgets(Sum):
    def merged(self, loaded, partial, join):
        return {}


class Invents(Sum):
    def merged(self, loaded, partial, join):
        return partial | {"more": torch.tensor(1)}


class NoState(Sum):
    def merged(self, loaded, partial, join):
        return None


class Raises(Sum):
    def merged(self, loaded, partial, join):
        raise AttributeError("oh")


class NeedsMore(Sum):
    def __init__(self, size):
        super().__init__()


class Early(Sum):
    def __init__(self):
        self.total = torch.tensor(0)


class NotASection:
    pass


class OddSection(Sum):
    config_section = NotASection


class BareSection(Section):
    size: int


class NoDefault(Sum):
    config_section = BareSection


class Grows(Sum):
    growing = ("totals",)


class Leads(Sum):
    rank = 5

    def belief(self, map_):
        raise AssertionError


class Named(Sum):
    name = "map"


class NamedAsModule(Sum):
    name = "train"


class NamedAsOther(Plain):
    name = "taken"


class CountsText(Sum):
    def counts(self):
        return {"odd": "many"}


class CountsFrames(Sum):
    def counts(self):
        return {"frames": 1}


class CountsNothing(Sum):
    def counts(self):
        return None


class DrawsVolume(Sum):
    def images(self):
        return {"odd": np.zeros((2, 2, 2))}


class DrawsTooEarly(Sum):
    def images(self):
        return {"odd": np.zeros((0, 3)).max(0)}


class WritesFrames(Sum):
    def tables(self):
        return {"frames.csv": "a\n"}


class WritesElsewhere(Sum):
    def tables(self):
        return {"../odd.csv": "a\n"}


class WritesNothing(Sum):
    def tables(self):
        return {"odd.csv": ""}


@pytest.mark.parametrize(
    ("kind", "cls", "said"),
    [
        ("odd", WithoutRule, r"no rule of merging for total; name each in merge_rules"),
        ("odd", TwoWithoutRule, "no rule of merging for total, inner.weight, inner.bias"),
        ("odd", Forgets, r"merged\(\) must return every name of the state; check total"),
        ("odd", Invents, r"merged\(\) must return every name of the state; check more"),
        ("odd", NoState, r"merged\(\) must return every name of the state; check total"),
        ("odd", Raises, r"two states without experience do not merge \(AttributeError: oh\)"),
        ("odd", NeedsMore, "cannot be built from the default config .*'size'"),
        ("odd", Early, "cannot be built from the default config"),
        ("odd", NoDefault, "BareSection has no defaults .*every parameter needs one"),
        ("odd", OddSection, "expected a subclass of Section"),
        ("odd", Grows, "growing names totals, which is no buffer of it"),
        ("odd", Leads, "has rank 5, but no decide, estimate"),
        ("odd", Named, "'map' cannot name its part of a brain"),
        ("odd", NamedAsModule, "'train' cannot name its part of a brain"),
        ("odd", NamedAsOther, "'taken' cannot name its part .* of Sum"),
        ("odd", CountsText, r"CountsText.counts\(\): 'odd' is str, expected a number"),
        ("odd", CountsFrames, "'frames' is a figure of every run"),
        ("odd", CountsNothing, r"CountsNothing.counts\(\): returned NoneType, expected a dict"),
        ("odd", DrawsVolume, r"'odd' is float64 \(2, 2, 2\); expected an array \(h, w\)"),
        ("odd", DrawsTooEarly, r"images\(\) fails without experience \(ValueError: zero-size"),
        ("odd", WritesFrames, "'frames.csv' is not a name for it; expected one like odd.csv"),
        ("odd", WritesElsewhere, "'../odd.csv' is not a name for it"),
        ("odd", WritesNothing, "expected text whose first line has the columns"),
        ("odd", int, "is no subclass of Population"),
        ("odd", len, "is no subclass of Population"),
        ("pose", Plain, "is a population of the package already"),
        ("head_direction", Plain, "is a population of the package already"),
        ("other", Sum, "is registered as 'taken' already; register a subclass"),
        ("taken", NamedAsOther, "Sum already; choose another name"),
        ("pose_cells", Plain, "is a name of the config already"),
        ("view", Plain, "is a name of the config already"),
        ("section", Plain, "is a name of the config already"),
        ("model_dump", Plain, "is a name of the config already"),
        ("clock", Plain, "'clock' cannot name its part of a brain"),
        ("merge", Plain, "'merge' cannot name its part of a brain"),
        ("black_and_white", Plain, "expected a name like head_direction"),
        ("two words", Plain, "expected a name like head_direction"),
        ("", Plain, "expected a name like head_direction"),
    ],
)
def test_what_cannot_be_a_population_is_refused_by_name(kind, cls, said):
    register("taken")(Sum)
    before, kinds = dict(populations.registered), populations.known_kinds()
    with pytest.raises(ConfigError, match=said) as told:
        register(kind)(cls)
    assert f"@register({kind!r})" in str(told.value)
    assert "\n" not in str(told.value)
    assert populations.registered == before
    assert populations.known_kinds() == kinds


def test_a_decorator_without_a_kind_says_what_it_needs():
    with pytest.raises(ConfigError, match=r"expected the kind of the population, as @register\("):
        register(Sum)


def test_a_class_that_was_refused_keeps_no_kind():
    class Fresh(Plain):
        merge_rules: ClassVar = {}

    with pytest.raises(ConfigError):
        register("fresh")(Fresh)
    assert not {"kind", "name"} & Fresh.__dict__.keys()


def test_a_notebooks_cell_may_run_twice_and_the_later_counts():
    made = []
    for _ in range(2):

        class Again(Sum):
            pass

        made.append(register("again")(Again))
    assert populations.population_class("again") is made[1] is not made[0]
    assert type(NavigationBrain(BrainConfig(cells="pose+again")).again) is made[1]


def test_the_second_registration_that_is_refused_leaves_the_first():
    class Again(Sum):
        pass

    first = register("again")(Again)

    class Again(Sum):
        merge_rules: ClassVar = {}

    with pytest.raises(ConfigError, match="no rule of merging"):
        register("again")(Again)
    assert populations.population_class("again") is first


def test_every_attribute_of_a_brain_is_kept_from_being_a_name():
    brain = NavigationBrain(BrainConfig(cells="+".join(populations.HOMES)))
    own = {p.name for p in brain.populations.values()} - BRAIN_NAMES
    public = {name for name in dir(brain) if name[0] != "_" and not hasattr(nn.Module, name)}
    assert public - BRAIN_NAMES - own - {"training"} == set()


def test_every_figure_and_table_of_a_run_is_kept_from_being_a_populations():
    assert set(RunSummary().to_dict()) <= set(RUN_FIGURES)
    assert {name for name in RUN_FILES if name.endswith(".csv")} == set(RUN_TABLES)


class Loud(Sum):
    """Uses one name for each kind of answer, as another does."""

    def counts(self):
        return {"visits": 1}

    def scalars(self):
        return {"cells/visits": 1.0}

    def images(self):
        return {"cells/visits": np.ones((2, 2))}

    def tables(self):
        return {"visits.csv": "a\n"}


def only(hook, **more):
    """A population that gives one of these answers, or others."""
    members = {hook: getattr(Loud, hook)}
    return type("Quiet", (Sum,), members | {k: lambda _self, v=v: v for k, v in more.items()})


@pytest.mark.parametrize("hook", ["counts", "scalars", "images", "tables"])
def test_two_populations_of_a_brain_cannot_use_one_name(hook):
    register("loud")(Loud)
    register("quiet")(only(hook))
    NavigationBrain(BrainConfig(cells="pose+quiet"))
    said = rf"cells = pose\+loud\+quiet: Loud and Quiet: both name one of their {hook}\(\) '"
    with pytest.raises(ConfigError, match=said):
        NavigationBrain(BrainConfig(cells="pose+loud+quiet"))


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ({"counts": {"place_cells": 1}}, r"NavigationCells and Quiet: both .* 'place_cells'"),
        ({"scalars": {"cells/walls": 1.0}}, r"NavigationCells and Quiet: both .* 'cells/walls'"),
        ({"tables": {"Landmarks.csv": "a\n"}}, r"SemanticCells and Quiet: both .*andmarks.csv'"),
    ],
)
def test_nor_a_name_of_the_packages_populations(answers, said):
    (hook,) = answers
    register("quiet")(only(hook, **answers))
    with pytest.raises(ConfigError, match=said):
        NavigationBrain(BrainConfig(cells="pose+place+semantic+quiet"))
    with pytest.raises(ConfigError, match="both name one of their"):
        NavigationBrain(BrainConfig(cells="place+semantic+quiet"))


def test_a_name_that_comes_with_experience_is_refused_when_it_is_asked_for():
    class Late(Sum):
        def counts(self):
            return {"place_cells": 2} if self.total else {}

    register("late")(Late)
    brain = NavigationBrain(BrainConfig(cells="place+late"))
    brain.late.total += 1
    with pytest.raises(TypeError, match="NavigationCells and Late: both name one of their counts"):
        gathered(brain.populations.values(), counts_of)


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ({"counts": {"experiences": 1}}, r"Quiet.counts\(\): 'experiences' is a figure of every"),
        ({"scalars": {"map/links": 1}}, r"Quiet.scalars\(\): 'map/links' is a tag of every run"),
        ({"images": {"ssp/map": np.ones((2, 2))}}, r"Quiet.images\(\): 'ssp/map' is a tag of"),
        ({"tables": {"frames.csv": "a\n"}}, r"Quiet.tables\(\): 'frames.csv' is not a name"),
        ({"tables": {"Links.csv": "a\n"}}, r"Quiet.tables\(\): 'Links.csv' is not a name"),
    ],
)
def test_names_of_the_run_itself_are_refused_at_registration(answers, said):
    (hook,) = answers
    with pytest.raises(ConfigError, match=said):
        register("quiet")(only(hook, **answers))


def test_the_packages_populations_have_names_of_their_own():
    brain = NavigationBrain(BrainConfig(cells="+".join(populations.HOMES)))
    check_names(brain.populations.values())


def test_answers_may_be_of_numpy_or_torch_and_are_plain_afterwards():
    class Odd(Sum):
        kind = "odd"

        def counts(self):
            return {"a": torch.tensor(3), "b": np.int64(4), "c": np.float32(0.5), "d": True}

        def scalars(self):
            return {"a": torch.tensor([2.5]), "b": np.array(1)}

        def images(self):
            return {
                "none": np.zeros((0, 4)),
                "tensor": torch.ones(2, 3),
                "layers": [np.ones((2, 2)), torch.ones(2, 1)],
                "rgb": np.zeros((2, 2, 3), np.uint8),
            }

        def tables(self):
            return {"odd.csv": "a,b\n1,2\n"}

    odd = Odd()
    assert [(n, v, type(v)) for n, v in counts_of(odd).items()] == [
        ("a", 3, int), ("b", 4, int), ("c", 0.5, float), ("d", 1, int)
    ]  # fmt: skip
    assert scalars_of(odd) == {"a": 2.5, "b": 1}
    pictures = pictures_of(odd)
    assert list(pictures) == ["tensor", "layers", "rgb"]
    assert type(pictures["tensor"]) is np.ndarray
    assert [layer.shape for layer in pictures["layers"]] == [(2, 2), (2, 1)]
    assert tables_of(odd) == {"odd.csv": "a,b\n1,2\n"}


# --- files ---------------------------------------------------------------------------------------

GOOD = textwrap.dedent(
    """
    from neuroslam.state.population import Population
    from neuroslam.state.registry import register

    @register("filed")
    class Filed(Population):
        VALUE = 1
    """
)


def test_a_file_registers_once_and_again_when_it_was_changed(tmp_path):
    path = tmp_path / "filed.py"
    path.write_text(GOOD)
    populations.load_plugin(path)
    first = populations.population_class("filed")
    populations.load_plugin(tmp_path / "." / "filed.py")
    assert populations.population_class("filed") is first
    assert os.environ[populations.PLUGINS] == str(path.resolve())
    path.write_text(GOOD.replace("VALUE = 1", "VALUE = 2"))
    populations.load_plugin(path)
    assert populations.population_class("filed").VALUE == 2
    path.write_text("1 / 0")
    with pytest.raises(ConfigError, match="ZeroDivisionError"):
        populations.load_plugin(path)
    assert populations.population_class("filed").VALUE == 2


def test_a_file_that_fails_takes_nothing_of_the_package_with_it(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("import neuroslam.cells.speed\n1 / 0\n")
    with pytest.raises(ConfigError, match="ZeroDivisionError"):
        populations.load_plugin(path)
    assert NavigationBrain(BrainConfig(cells="pose+speed")).speed


def test_two_files_may_have_one_name_but_not_one_kind(tmp_path):
    for folder, kind in (("a", "first"), ("b", "second"), ("c", "first")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "filed.py").write_text(GOOD.replace("filed", kind))
    populations.load_plugin(tmp_path / "a" / "filed.py")
    populations.load_plugin(tmp_path / "b" / "filed.py")
    assert populations.population_class("first") is not populations.population_class("second")
    with pytest.raises(ConfigError, match=r"Filed already; choose another name"):
        populations.load_plugin(tmp_path / "c" / "filed.py")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such file; expected a Python file"),
        ("def", r", line 1: SyntaxError|: SyntaxError"),
        ("x = 1\ny = x + z\n", ", line 2: NameError: name 'z' is not defined"),
        (
            "import nowhere_at_all",
            ", line 1: ModuleNotFoundError: No module named 'nowhere_at_all'",
        ),
        ("x = 1", "registers no population; decorate one with @register"),
        ("import sys\nsys.exit(0)", ", line 2: SystemExit: 0"),
        ("raise ValueError('two\\nlines')", ", line 1: ValueError: two"),
        (GOOD + "\n1 / 0\n", ", line 9: ZeroDivisionError: division by zero"),
        (GOOD.replace("filed", "pose"), r"@register\('pose'\): is a population of the package"),
    ],
)
def test_a_file_that_cannot_be_used_is_told_in_one_line_and_leaves_nothing(text, said, tmp_path):
    path = tmp_path / "wrong.py"
    if text is not None:
        path.write_text(text)
    before = dict(populations.registered)
    with pytest.raises(ConfigError, match=said) as told:
        populations.load_plugin(path)
    assert "\n" not in str(told.value)
    assert populations.registered == before
    assert os.environ[populations.PLUGINS] == ""
    assert not any(name.startswith("neuroslam_plugin_wrong") for name in sys.modules)


def test_a_file_may_make_a_config_of_itself_in_a_process_that_was_started(tmp_path, monkeypatch):
    path = tmp_path / "filed.py"
    path.write_text(GOOD + "\nfrom neuroslam.config import BrainConfig\n"
                    "C = BrainConfig(cells='pose+filed')\n")  # fmt: skip
    monkeypatch.setenv(populations.PLUGINS, str(path))  # as the process that started this one set
    assert BrainConfig(cells="pose+filed").cells == ("pose", "filed")


# --- installed packages --------------------------------------------------------------------------


def install(folder, module, text, kind="installed"):
    """Lay out a package as an installer does."""
    (folder / f"{module}.py").write_text(text)
    about = folder / f"{module}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[neuroslam.populations]\n{kind} = {module}:Filed\n")


def test_an_installed_package_adds_its_population(tmp_path, monkeypatch):
    install(tmp_path, "acme_cells", GOOD.replace("filed", "installed"))
    assert "installed" not in populations.known_kinds()
    monkeypatch.syspath_prepend(tmp_path)
    assert "installed" in populations.known_kinds()
    assert "acme_cells" not in sys.modules, "it is imported when it is used"
    brain = NavigationBrain(BrainConfig(cells="pose+installed"))
    assert type(brain.installed).__module__ == "acme_cells"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import nowhere_at_all", r"acme_wrong:Filed: cannot be imported \(ModuleNotFoundError"),
        ("class Filed: pass", r"is not registered; expected @register\('installed'\)"),
    ],
)
def test_an_installed_package_that_cannot_be_used_is_named(text, said, tmp_path, monkeypatch):
    install(tmp_path, "acme_wrong", text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=said):
        populations.population_class("installed")


def test_about_now_needs_no_thought_for_one_that_learns_nothing():
    class Idle(Sum):
        merge_rules: ClassVar = {"total": about_now}

    assert register("idle")(Idle).kind == "idle"
