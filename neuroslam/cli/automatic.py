"""The preset ``auto`` of commands: what is estimated from a source before it is mapped."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuroslam.cli.output import say
from neuroslam.errors import NeuroslamError

if TYPE_CHECKING:
    from neuroslam.config import BrainConfig


def estimated(
    source: str,
    config: Path | None,
    given: tuple[str, ...],
    settings: "BrainConfig",
    preset: str | None,
    stop: int | None = None,
    offset: str | None = None,
) -> tuple["BrainConfig", str | None]:
    """Return the preset ``auto`` with what is estimated from the first laps of the source.

    Without a preset, a source that is too short, or has no pictures, keeps the settings it has.
    """
    from neuroslam.runs.clocks import resolve_offset
    from neuroslam.runs.run import resolve_config
    from neuroslam.sensors import open_source
    from neuroslam.tuning.auto import estimate, has_pictures

    source, _ = resolve_offset(source, offset, settings)
    opened = open_source(source, settings.frame_rate_hz, settings.view.grey)
    plain = settings.view.features == "grey"
    if preset is None and not (plain and has_pictures(opened)):
        return settings, None
    automatic = resolve_config("auto", config, given)
    estimates = estimate(opened, automatic, stop)
    if not plain:  # estimated from grey views
        estimates.values.pop("view", None)
    if preset is None and not estimates.values:
        return settings, None
    for note in estimates.notes:
        say(note)
    return resolve_config("auto", config, given, estimated=estimates.values), "auto"


def estimates(
    source: str, config: Path | None, given: tuple[str, ...], stop: int | None
) -> dict[str, dict[str, Any]]:
    """Return what the preset ``auto`` estimates from a source, none of one that cannot be read."""
    from neuroslam.runs.run import resolve_config
    from neuroslam.sensors import open_source
    from neuroslam.tuning.auto import estimate

    automatic = resolve_config("auto", config, given)
    try:
        found = estimate(open_source(source, automatic.frame_rate_hz), automatic, stop)
    except NeuroslamError:  # its runs fail and say so
        return {}
    for note in found.notes:
        say(f"{source}: {note}")
    return found.values


def estimated_for_all(
    sources: Sequence[str],
    config: Path | None,
    given: tuple[str, ...],
    settings: "BrainConfig",
    preset: str | None,
) -> tuple["BrainConfig", str | None]:
    """Return one config for the robots of a fleet: views of one kind, and one scale of speed.

    It is estimated from the first source that it can be estimated from.
    """
    for source in sources:
        try:
            found, named = estimated(source, config, given, settings, preset)
        except NeuroslamError:  # its session fails and says so
            continue
        if named is not None:
            return found, named
    return settings, preset
