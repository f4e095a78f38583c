"""Write ``docs/parameters.md`` from the config classes: ``python docs/parameters.py``."""

from pathlib import Path
from typing import TypeGuard

from pydantic import BaseModel

from neuroslam.config import CLASSIC_NAMES, BrainConfig
from neuroslam.config.populations import HOMES, section_class

HEAD = """# Parameters

Set one parameter with `--set section.key=value`, several in a TOML file (`--config`), or take a
preset (`--preset`). Every run writes its complete config beside its results. Units are part of the
names: `_m` metres, `_s` seconds, `_rad` radians, `_deg` degrees, `_hz` 1/s, `_px` pixels.

The last column is the name in OpenRatSLAM's `.ini` and `.txt` files, which `--config` reads too. Of
those, `camera_hz` is `frame_rate_hz` here; `image_crop_*`, `vtrans_image_*` and `vrot_image_*` are
`view.crop`, `odometry.speed_region` and `odometry.turn_region`, each `[x_min, x_max, y_min, y_max]`
in pixels.
"""


COLUMNS = "| key | default | bounds | meaning | OpenRatSLAM |\n|---|---|---|---|---|"


def bounds(metadata: list[object]) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<=", "max_length": "length <="}
    found = [
        f"{sign} {getattr(each, name):.16g}"
        for each in metadata
        for name, sign in signs.items()
        if getattr(each, name, None) is not None
    ]
    return ", ".join(found)


def is_section(annotation: object) -> TypeGuard[type[BaseModel]]:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def tables(section: type[BaseModel], path: str) -> list[str]:
    """Return a table of a section's own parameters, then those of the sections within it."""
    classic = {name: theirs for theirs, name in CLASSIC_NAMES.items()}
    rows, inner = [], []
    for key, each in section.model_fields.items():
        if is_section(each.annotation):
            inner += tables(each.annotation, f"{path}.{key}")
            continue
        default = "none" if each.default is None else each.default
        rows.append(
            f"| `{key}` | {default} | {bounds(each.metadata)} | {each.description or ''} | "
            f"{'`' + classic[path, key] + '`' if (path, key) in classic else ''} |"
        )
    return [
        f"\n## `[{path}]`\n{(section.__doc__ or '').splitlines()[0]}\n\n{COLUMNS}",
        *rows,
        *inner,
    ]


def page() -> str:
    """Return the text of the page."""
    parts: list[str] = [HEAD]
    general: list[str] = []
    for name, field in BrainConfig.model_fields.items():
        if is_section(field.annotation):
            parts += tables(field.annotation, name)
        else:
            general.append(
                f"| `{name}` | {field.default} | {bounds(field.metadata)} | {field.description} | |"
            )
    for kind in HOMES:
        if (section := section_class(kind)) is not None:
            parts += tables(section, kind)
    parts.append(f"\n## Outside of sections\n\n{COLUMNS}")
    return "\n".join(parts + general) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("parameters.md").write_text(page(), encoding="utf-8")
