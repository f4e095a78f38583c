"""Configs: bounds, unknown keys, files, presets, OpenRatSLAM's own files."""

import importlib.util
import tomllib
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from neuroslam.brain import NavigationBrain
from neuroslam.cells import NavigationCells
from neuroslam.config import (
    CLASSIC_NAMES,
    BrainConfig,
    GridCellConfig,
    PoseCellConfig,
    ViewConfig,
    build_config,
    merge_values,
    parse_assignment,
    preset_names,
    read_config_file,
    read_preset,
    to_toml,
)
from neuroslam.config.semantic import SSPSpaceConfig
from neuroslam.errors import ConfigError, RenamedKeyWarning
from neuroslam.runs.run import resolve_config
from neuroslam.sensors import open_source


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_is_a_config_and_survives_toml(name):
    config = build_config(read_preset(name))
    assert build_config(tomllib.loads(to_toml(config))) == config


def test_presets_exist_for_the_published_data():
    wanted = {"openratslam", "irat", "new_college", "lab_tour", "virtual_tour", "rc_car"}
    wanted |= {"multisession_2023"}
    assert wanted <= set(preset_names())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"view": {"treshold": 0.1}},
            r"unknown key 'view.treshold'; did you mean 'view.threshold'",
        ),
        ({"threshold": 0.1}, r"unknown key 'threshold'; did you mean 'view.threshold'"),
        ({"view": {"threshold": 2}}, r"view.threshold = 2: input should be less than 1"),
        ({"view": {"shift_match": 30}}, r"shift_match 30 leaves no column of template_width 60"),
        ({"pose_cells": {"n_xy": 3}}, r"pose_cells.n_xy = 3: input should be greater than"),
        ({"map": {"correction": 0.7}}, r"map.correction = 0.7"),
        ({"map": {"correction": float("nan")}}, r"map.correction"),
        ({"odometry": {"fov_deg": float("inf")}}, r"odometry.fov_deg"),
        ({"view": 3}, r"view = 3: is a section; set one of its keys, as view\.KEY"),
        ({"view": {"crop": [0, 1, 2]}}, r"view\.crop = .*expected four whole numbers x_min"),
        ({"view": {"crop": [0, 1, 2, "x"]}}, r"view\.crop = 'x': expected four whole numbers"),
        ({"map": {"solver": "magic"}}, r"map.solver = 'magic': input should be 'relax', 'l"),
        ({"map": {"solver": "relx"}}, r"map.solver = 'relx': .*; did you mean 'relax'\?$"),
        ({"cells": "pose+plase"}, r"unknown population 'plase'; .*; did you mean 'place'\?"),
        ({"veiw": {}}, r"config: unknown key 'veiw'; did you mean 'view'\?$"),
        ({"view": {"n_xy": 9}}, r"unknown key 'view\.n_xy'; did you mean 'pose_cells\.n_xy'\?$"),
        (
            {"view": {"threshold": 2}, "semantic": {"space": {"reach": 3.0}}},
            r"key 'semantic\.space\.reach'; did you mean 'semantic\.space\.reach_m'\?$",
        ),
        (
            {"sigma_m": 0.1},
            r"'sigma_m'; did you mean 'map\.sigma_m' or 'boundary_cells\.sigma_m' or "
            r"'wall_memory\.sigma_m'\?$",
        ),
        ({"view": {"{0}": 1}}, r"unknown key 'view\.\{0\}'"),
        ({"view": {"features": "gray"}}, r"features gray needs weights: .*; did you mean 'grey'\?"),
    ],
)
def test_an_invalid_config_raises_one_line(values, message):
    with pytest.raises(ConfigError, match=message) as caught:
        build_config(values)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "where", "message"),
    [
        (
            lambda: BrainConfig(veiw={}),
            ("veiw",),
            "unknown key 'veiw'; did you mean 'view'?",
        ),
        (
            lambda: BrainConfig(view={"treshold": 0.1}),
            ("view", "treshold"),
            "unknown key 'view.treshold'; did you mean 'view.threshold'?",
        ),
        (
            lambda: PoseCellConfig(n_xz=3),
            ("n_xz",),
            "unknown key 'n_xz'; did you mean 'n_xy'?",
        ),
        (
            lambda: BrainConfig(semantic={"space": {"reach": 3.0}}),
            ("semantic", "space", "reach"),
            "unknown key 'semantic.space.reach'; did you mean 'semantic.space.reach_m'?",
        ),
        (
            lambda: BrainConfig(semantic={"tier": "spikin"}),
            ("semantic", "tier"),
            "Input should be 'algebraic', 'rate' or 'spiking'; did you mean 'spiking'?",
        ),
        (lambda: PoseCellConfig(mood="fine"), ("mood",), "unknown key 'mood'"),
    ],
)
def test_a_config_made_in_python_suggests_the_known_name(make, where, message):
    with pytest.raises(ValidationError) as caught:
        make()
    [error] = caught.value.errors()
    assert (error["loc"], error["msg"]) == (where, message)


def test_other_errors_are_listed_after_unknown_keys():
    with pytest.raises(ValidationError) as caught:
        BrainConfig(map={"solver": "relx"}, threads=0, view={"threshold": 2, "crp": None})
    errors = caught.value.errors()
    assert [error["type"] for error in errors] == [
        "unknown_key", "less_than", "literal_error", "greater_than_equal",
    ]  # fmt: skip
    assert caught.value.title == "BrainConfig"


def test_a_config_is_frozen():
    with pytest.raises(ValueError, match="frozen"):
        BrainConfig().view.threshold = 3


def test_later_values_replace_earlier_ones():
    over = merge_values(read_preset("rc_car"), parse_assignment("view.threshold=0.01"))
    config = build_config(over)
    assert config.view.threshold == 0.01
    assert (
        config.pose_cells.cell_size_m == build_config(read_preset("rc_car")).pose_cells.cell_size_m
    )


def test_assignments_read_toml_values():
    assert parse_assignment("view.crop=[0, 160, 0, 60]") == {"view": {"crop": [0, 160, 0, 60]}}
    assert parse_assignment("map.solver=least_squares") == {"map": {"solver": "least_squares"}}
    with pytest.raises(ConfigError, match=r"expected section\.key=value"):
        parse_assignment("nonsense")


# --- names of the last release ------------------------------------------------------------------

OLD_NAME = r"^sessions: carried is called kidnapped now; the old name is read until the next"


def test_an_old_name_is_read_with_a_warning():
    with pytest.warns(RenamedKeyWarning) as told:
        config = build_config({"sessions": {"carried": "ignore", "carried_factor": 3.5}})
    assert (config.sessions.kidnapped, config.sessions.kidnapped_factor) == ("ignore", 3.5)
    assert len(told) == 2


def test_a_file_and_an_assignment_with_an_old_name_are_read_with_a_warning(tmp_path):
    (tmp_path / "old.toml").write_text('[sessions]\ncarried = "ignore"\n')
    with pytest.warns(RenamedKeyWarning, match=OLD_NAME):
        values = read_config_file(tmp_path / "old.toml")
    assert values == {"sessions": {"kidnapped": "ignore"}}
    with pytest.warns(RenamedKeyWarning, match=OLD_NAME):
        assert parse_assignment("sessions.carried=detect") == {"sessions": {"kidnapped": "detect"}}


def test_the_later_wins_whatever_name_it_has(tmp_path):
    (tmp_path / "old.toml").write_text('[sessions]\ncarried = "detect"\n')
    assert resolve_config("openratslam").sessions.kidnapped == "ignore"
    with pytest.warns(RenamedKeyWarning):
        over_preset = resolve_config("openratslam", None, ("sessions.carried=detect",))
    with pytest.warns(RenamedKeyWarning):
        over_file = resolve_config(None, tmp_path / "old.toml", ("sessions.kidnapped=ignore",))
    base = BrainConfig(sessions={"kidnapped": "detect"})
    with pytest.warns(RenamedKeyWarning):
        over_base = resolve_config(None, None, ("sessions.carried=ignore",), base)
    assert [c.sessions.kidnapped for c in (over_preset, over_file, over_base)] == [
        "detect", "ignore", "ignore",
    ]  # fmt: skip


def test_two_names_of_one_key_are_refused():
    with pytest.raises(ConfigError, match=r"unknown key 'sessions\.carried'"):
        build_config({"sessions": {"carried": "ignore", "kidnapped": "detect"}})


def test_a_world_reads_the_old_name_of_an_option_with_a_warning():
    with pytest.warns(RenamedKeyWarning, match="carried is called kidnapped now"):
        old = open_source("world:corridor?laps=1&frames_per_lap=60&carried=2:0.5")
    new = open_source("world:corridor?laps=1&frames_per_lap=60&kidnapped=2:0.5")
    np.testing.assert_array_equal(old.truths(), new.truths())
    still = open_source("world:corridor?laps=1&frames_per_lap=60")
    assert not np.array_equal(old.truths(), still.truths())


# --- dependent parameters ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spacings_m", "orientations_deg"),
    [
        ((0.25,), (0.0,)),
        ((0.5, 0.7), (0.0, 15.0)),
        ((0.35, 0.46, 0.6, 0.78), (0.0, 15.0, -10.0, 7.0)),
        # 60 / 1.618 = 37.08 degrees, times 4, 5 and 6, wrapped to [-30, 30)
        ((0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8), (0.0, 15.0, -10.0, 7.0, 28.3, 5.4, -17.5)),
    ],
)
def test_orientations_follow_the_number_of_spacings(spacings_m, orientations_deg):
    config = BrainConfig(grid_cells={"spacings_m": spacings_m})
    assert config.grid_cells.orientations_deg == orientations_deg
    assert build_config(tomllib.loads(to_toml(config))) == config
    assert build_config({"grid_cells": {"spacings_m": list(spacings_m)}}) == config


@pytest.mark.parametrize(
    ("orientations_deg", "spacings_m"),
    [
        ((5.0,), (0.35,)),
        ((5.0, 6.0, 7.0), (0.35, 0.46, 0.6)),
        ((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), (0.35, 0.46, 0.6, 0.78, 1.01, 1.31)),
    ],
)
def test_spacings_follow_the_number_of_orientations(orientations_deg, spacings_m):
    config = GridCellConfig(orientations_deg=orientations_deg)
    assert config.spacings_m == spacings_m
    assert config.orientations_deg == orientations_deg


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"spacings_m": [0.3], "orientations_deg": [0.0, 15.0]},
            "spacings_m has 1 modules, orientations_deg 2; expected the same, or only one of the",
        ),
        ({"orientations_deg": []}, "spacings_m has 1 modules, orientations_deg 0"),
        ({"spacings_m": []}, r"spacings_m = \[\]: tuple should have at least 1 item"),
        ({"spacings_m": 0.3}, r"spacings_m = 0\.3: expected a list in brackets"),
        ({"spacings_m": "0.3"}, r"spacings_m = '0\.3': expected a list in brackets"),
        ({"spacings_m": [-0.3]}, r"spacings_m has -0\.3; expected more than 0"),
    ],
)
def test_spacings_and_orientations_of_different_length_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        build_config({"grid_cells": values})


def test_navigation_cells_have_one_module_for_one_spacing():
    cells = NavigationCells(BrainConfig(grid_cells={"spacings_m": (0.25,), "n_cells": 4}))
    assert cells.grid.rates.shape == (1, 4)


@pytest.mark.parametrize(("width", "shift"), [(2, 0), (5, 2), (8, 3), (9, 4), (60, 4)])
def test_the_default_shift_fits_a_narrow_template(width, shift):
    assert ViewConfig(template_width=width).shift_match == shift
    with pytest.raises(ValidationError, match="leaves no column"):
        ViewConfig(template_width=width, shift_match=(width + 1) // 2)


def test_the_dimension_follows_the_length_of_scale_lists():
    assert SSPSpaceConfig(reach_m=(1.0, 2.0, 3.0)).dimension == 3
    assert SSPSpaceConfig(length_scale_m=(0.2, 0.3, 0.4), reach_m=(1.0, 2.0, 3.0)).dimension == 3
    assert SSPSpaceConfig(reach_m=2.0).dimension == 2
    with pytest.raises(ValidationError, match="expected one positive number or 2 of them"):
        SSPSpaceConfig(dimension=2, reach_m=(1.0, 2.0, 3.0))
    with pytest.raises(
        ConfigError, match=r"space.dimension is 3; expected 2: a brain maps a plane"
    ):
        build_config({"semantic": {"space": {"reach_m": [1.0, 2.0, 3.0]}}})


# --- files --------------------------------------------------------------------------------------


def test_openratslam_files_are_read(shared):
    path = shared / "refs" / "ratslam" / "config_usi_track1.ini"
    config = resolve_config("openratslam", path)
    assert config.view.crop == (0, 160, 0, 60)
    assert config.view.threshold == 0.035
    assert config.odometry.turn_region == (20, 140, 10, 60)
    assert config.pose_cells.inhibit_std_theta == 2.0
    assert config.view.panoramic is False
    assert config.map.loops == 20


def test_a_classic_file_may_have_comments_and_topics(tmp_path):
    path = tmp_path / "irat.txt"
    path.write_text(
        "[general]\ntopic_root=irat_red\n[ratslam]\nvt_match_threshold=0.04 # a comment\n"
        "pc_dim_th=36\n[draw]\nenable=1\n"
    )
    values = read_config_file(path)
    assert values.keys() == {"view", "pose_cells", "map"}  # nothing of visual odometry
    assert (values["view"]["threshold"], values["pose_cells"]["n_theta"]) == (0.04, 36)


# The keys of the files published with OpenRatSLAM, typed from them.
PUBLISHED = {
    "irat": """
[general]
topic_root=irat_red
[ratslam]
image_crop_y_max=150
template_x_size=60
template_y_size=20
vt_shift_match = 4
vt_step_match = 1
vt_match_threshold = 0.03
vt_active_decay = 1.0
pc_dim_xy = 11
pc_vt_inject_energy = 0.1
pc_cell_x_size = 0.015
exp_delta_pc_threshold = 2
exp_loops=20
exp_initial_em_deg=140
[draw]
enable=1
media_path=../src/media
image_file=irat_sm.tga
""",
    "new_college": """
[general]
topic_root=/newcollege/
[ratslam]
vt_match_threshold = 0.054
template_x_size=60
template_y_size=10
vt_panoramic=1
vt_patch_normalise=2
pc_cell_x_size = 1.0
pc_dim_xy = 30
exp_delta_pc_threshold = 2.0
pc_vt_inject_energy = 0.2
vt_active_decay = 1.0
exp_loops=100
""",
    "st_lucia": """
[ratslam]
image_crop_x_min=40
image_crop_x_max=600
image_crop_y_min=120
image_crop_y_max=280
vt_match_threshold = 0.048
template_x_size=280
template_y_size=1
vt_shift_match = 11
vt_step_match = 5
vt_normalisation = 1
pc_vt_restore=0.04
pc_cell_x_size = 2
pc_dim_xy = 30
exp_delta_pc_threshold = 1.0
pc_vt_inject_energy = 0.10
vt_active_decay = 1.0
exp_loops=20
[visual_odometry]
vtrans_image_x_min=195
vtrans_image_x_max=475
vtrans_image_y_min=270
vtrans_image_y_max=430
vrot_image_x_min=195
vrot_image_x_max=475
vrot_image_y_min=75
vrot_image_y_max=240
camera_fov_deg=53
camera_hz = 10
vtrans_scaling = 1000
vtrans_max=20
""",
}


def published(name, folder):
    (folder / f"{name}.txt").write_text(PUBLISHED[name])
    return resolve_config("openratslam", folder / f"{name}.txt")


def test_the_published_files_of_openratslam_load_as_they_are(tmp_path):
    irat, college, lucia = (published(name, tmp_path) for name in PUBLISHED)
    assert irat.view.crop == (0, -1, 0, 150)
    assert (irat.view.normalisation, irat.view.shift_match, irat.view.shift_step) == (0.0, 4, 1)
    assert (irat.pose_cells.restore, irat.map.correction) == (0.05, 0.5)
    assert (college.view.shift_match, college.view.shift_step) == (25, 5)
    assert (college.view.panoramic, college.view.patch_radius, college.view.crop) == (True, 2, None)
    assert (college.map.loops, college.map.initial_heading_deg) == (100, 90.0)
    assert (lucia.view.template_height, lucia.view.normalisation) == (1, 1.0)
    assert (lucia.odometry.fov_deg, lucia.frame_rate_hz) == (53.0, 10.0)


@pytest.mark.parametrize(("name", "world"), [
    ("irat", "corridor?width=416&height=240"),
    ("new_college", "campus?width=240&height=60"),
    ("st_lucia", "town?width=640&height=480&odometry=false"),
])  # fmt: skip
def test_a_brain_drives_with_a_published_file(name, world, tmp_path):
    brain = NavigationBrain(published(name, tmp_path))
    for frame in open_source(f"world:{world}&noise=0.02").frames(0, 25):
        brain(frame)
    assert brain.view.n > 0
    assert brain.map.n > 0


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.ini", "[ratslam]\nvt_match_treshold=1\n", "unknown key 'vt_match_treshold'.*did you"),
        (
            "a.ini",
            "[ratslam]\nvrot_image_xmin=1\n",
            "key 'vrot_image_xmin' in .*did you mean 'vrot_image_x_min'",
        ),
        ("a.ini", "[ratslam]\nvt_match_threshold=x\n", "expected a number"),
        ("a.ini", "no section\n", "not an OpenRatSLAM file"),
        ("a.toml", "view = [", "not valid TOML"),
        ("a.toml", b"\xff\xfe\x00", "cannot be read as text"),
    ],
)
def test_the_error_names_a_file_that_cannot_be_read(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError, match=message) as caught:
        read_config_file(path)
    assert name in str(caught.value)


def test_the_error_names_a_missing_file_or_preset(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        read_config_file(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match=r"no such file; rc_car is a preset, --preset rc_car$"):
        read_config_file(Path("rc_car"))
    with pytest.raises(ConfigError, match=r"unknown preset 'rc_cart'.*did you mean 'rc_car'"):
        read_preset("rc_cart")


def test_every_openratslam_name_maps_to_a_config_field():
    config = BrainConfig()
    for section, name in CLASSIC_NAMES.values():
        assert hasattr(getattr(config, section), name)


def test_the_parameter_page_is_up_to_date():
    docs = Path(__file__).resolve().parents[2] / "docs"
    spec = importlib.util.spec_from_file_location("parameters", docs / "parameters.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (docs / "parameters.md").read_text() == module.page(), "run: python docs/parameters.py"


def described(section, path=""):
    for key, field in section.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            assert inner.__doc__, f"{path}{key}"
            yield from described(inner, f"{path}{key}.")
        else:
            assert field.description, f"{path}{key}"
            yield f"{path}{key}"


def test_every_parameter_has_a_description():
    assert "semantic.space.reach_m" in set(described(BrainConfig))
