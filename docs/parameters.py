"""Write ``docs/parameters.md`` from the configs: ``python docs/parameters.py``."""

from pathlib import Path

from pydantic import BaseModel

from neuroslam.config import CLASSIC_NAMES, BrainConfig

HEAD = """# Parameters

Every parameter with its default, its bounds and what it does. Set one with
`--set section.key=value`, several in a TOML file (`--config`), or take a preset (`--preset`); the
config in force is written beside each result. The last column is OpenRatSLAM's name: its `.ini` and
`.txt` files are read as they are (`--config irat.txt`).

Regions are `[x_min, x_max, y_min, y_max]` in pixels. `camera_hz` is our `frame_rate_hz`;
`image_crop_*`, `vtrans_image_*` and `vrot_image_*` are our `view.crop`, `odometry.speed_region` and
`odometry.turn_region`.
"""


COLUMNS = "| key | default | bounds | what it does | OpenRatSLAM |\n|---|---|---|---|---|"


def bounds(metadata: list[object]) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    found = [
        f"{sign} {getattr(each, name):g}"
        for each in metadata
        for name, sign in signs.items()
        if getattr(each, name, None) is not None
    ]
    return ", ".join(found)


def is_section(annotation: object) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def tables(section: type[BaseModel], path: str) -> list[str]:
    """A table of a section's own parameters, then those of the sections within it."""
    classic = {ours: theirs for theirs, ours in CLASSIC_NAMES.items()}
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
    return [f"\n## `[{path}]`\n{section.__doc__.splitlines()[0]}\n\n{COLUMNS}", *rows, *inner]


def page() -> str:
    """The whole page."""
    parts, general = [HEAD], []
    for name, field in BrainConfig.model_fields.items():
        if is_section(field.annotation):
            parts += tables(field.annotation, name)
        else:
            general.append(
                f"| `{name}` | {field.default} | {bounds(field.metadata)} | {field.description} | |"
            )
    parts.append(f"\n## Besides\n\n{COLUMNS}")
    return "\n".join(parts + general) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("parameters.md").write_text(page(), encoding="utf-8")
