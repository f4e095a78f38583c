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


def page() -> str:
    """The whole page."""
    classic = {ours: theirs for theirs, ours in CLASSIC_NAMES.items()}
    parts = [HEAD]
    general = []
    for name, field in BrainConfig.model_fields.items():
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            general.append(
                f"| `{name}` | {field.default} | {bounds(field.metadata)} | {field.description} | |"
            )
            continue
        about = field.annotation.__doc__.splitlines()[0]
        parts.append(f"\n## `[{name}]`\n{about}\n\n{COLUMNS}")
        for key, each in field.annotation.model_fields.items():
            default = "none" if each.default is None else each.default
            parts.append(
                f"| `{key}` | {default} | {bounds(each.metadata)} | {each.description or ''} | "
                f"{'`' + classic[name, key] + '`' if (name, key) in classic else ''} |"
            )
    parts.append(f"\n## Besides\n\n{COLUMNS}")
    return "\n".join(parts + general) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("parameters.md").write_text(page(), encoding="utf-8")
