"""The options behind the ``?`` of a source that is made on the fly."""

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from neuroslam.errors import SourceError, did_you_mean, with_new_names

Options = TypeVar("Options", bound=BaseModel)


def parse_options(who: str, query: str, model: type[Options]) -> Options:
    """Read ``key=value&key=value`` into a model of what there is to set.

    Args:
        who: Whose options they are, for messages.
        query: What follows the ``?``; may be empty.
        model: Names, types, bounds and descriptions.

    Raises:
        SourceError: If a key is unknown or given twice, or a value is missing or cannot be used.

    Example:
        >>> from pydantic import Field
        >>> class Drive(BaseModel):
        ...     laps: int = Field(1, gt=0, description="times round")
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
            key = next(iter(with_new_names({key: value}, renamed, who)))
        if key not in model.model_fields:
            raise SourceError(
                f"{who}: unknown option {key!r}; there are {', '.join(model.model_fields)}"
                f"{did_you_mean(key, model.model_fields)}"
            )
        if not equals or key in values:
            problem = "is given twice" if key in values else "has no value"
            raise SourceError(f"{who}: option {key!r} {problem}; write {key}=VALUE once")
        values[key] = value
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = first["loc"][0]
        wish = first["msg"][0].lower() + first["msg"][1:]
        meaning = model.model_fields[key].description
        raise SourceError(f"{who}: option {key}={values[key]!r}: {wish} ({meaning})") from None
