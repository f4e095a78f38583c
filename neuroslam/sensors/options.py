"""Parses the options after the ``?`` of a source's name, as in ``world:town?laps=2``."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from neuroslam.errors import SourceError, did_you_mean, with_new_names

Options = TypeVar("Options", bound=BaseModel)


def parse_options(source: str, query: str, model: type[Options]) -> Options:
    """Read ``key=value&key=value`` into a model of the options.

    Args:
        source: Name of the source, for messages.
        query: Text after the ``?``; may be empty.
        model: Names, types, bounds and descriptions of the options.

    Raises:
        SourceError: If a key is unknown or repeated, or a value is missing or invalid.

    Example:
        >>> from pydantic import Field
        >>> class Drive(BaseModel):
        ...     laps: int = Field(default=1, gt=0, description="times round")
        >>> parse_options("ring", "laps=2", Drive).laps
        2
        >>> parse_options("ring", "lap=2", Drive)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        neuroslam.errors.SourceError: ring: unknown option 'lap'; there are laps; did you mean ...
    """
    values: dict[str, str] = {}
    renamed: dict[str, str] = getattr(model, "renamed", {})
    for item in filter(None, query.split("&")):
        key, equals, value = item.partition("=")
        if key in renamed:
            key = next(iter(with_new_names({key: value}, renamed, source)))
        if key not in model.model_fields:
            raise SourceError(
                f"{source}: unknown option {key!r}; there are {', '.join(model.model_fields)}"
                f"{did_you_mean(key, model.model_fields)}"
            )
        if not equals or key in values:
            problem = "is given twice" if key in values else "has no value"
            raise SourceError(f"{source}: option {key!r} {problem}; write {key}=VALUE once")
        values[key] = value
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        problem = first["msg"][0].lower() + first["msg"][1:]
        meaning = model.model_fields[name].description
        raise SourceError(
            f"{source}: option {name}={values[name]!r}: {problem} ({meaning})"
        ) from None


def split_track(spec: str) -> tuple[str, str, str]:
    """Split the name of a track into file, ``?`` and options; a file may have a ``?`` in its name.

    Example:
        >>> split_track("track:rat.csv?units=cm")
        ('rat.csv', '?', 'units=cm')
    """
    whole = spec.removeprefix("track:")
    name, mark, query = whole.rpartition("?")
    if not mark or Path(whole).is_file():
        return whole, "", ""
    return name, mark, query
