"""The base class of all config sections, whose errors suggest the key or choice that was meant."""

import re
from collections.abc import Mapping
from typing import Any, ClassVar, LiteralString, Self, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from neuroslam.errors import did_you_mean, nearest, with_new_names


class Section(BaseModel):
    """A group of parameters: frozen; unknown keys and infinite numbers are refused.

    The error for an unknown key or choice suggests the known one with the most similar name.

    Example:
        >>> from neuroslam.config import PoseCellConfig
        >>> PoseCellConfig(n_xz=20)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        pydantic_core._pydantic_core.ValidationError: 1 validation error for PoseCellConfig
        n_xz
          unknown key 'n_xz'; did you mean 'n_xy'? [type=unknown_key, ...]
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    renamed: ClassVar[Mapping[str, str]] = {}
    """Present name of each key that had another name in an earlier version."""

    @model_validator(mode="wrap")
    @classmethod
    def _suggest_known_names(cls, values: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if cls.renamed and isinstance(values, Mapping):
            values = with_new_names(values, cls.renamed, cls.__name__)
        try:
            return handler(values)
        except ValidationError as error:
            errors = error.errors(include_url=False)
            if not {each["type"] for each in errors} & {"extra_forbidden", *_WITH_HINTS}:
                raise
        # Unknown keys first: the other errors may follow from them.
        errors.sort(key=lambda each: each["type"] not in ("extra_forbidden", "unknown_key"))
        lines = [_with_hint(cls, each) for each in errors]
        raise ValidationError.from_exception_data(cls.__name__, lines)


_WITH_HINTS = ("unknown_key", "literal_error", "tuple_type", "list_type")


def _with_hint(section: type[BaseModel], error: ErrorDetails) -> InitErrorDetails:
    """Add a suggestion to a pydantic error about an unknown key or choice."""
    kind, message, context = error["type"], error["msg"], error.get("ctx", {})
    if kind in ("extra_forbidden", "unknown_key"):  # the latter comes from an inner section
        key = ".".join(str(part) for part in error["loc"])
        _, separator, suggestion = message.partition("; did you mean ")
        own = str(error["loc"][0]) in section.model_fields or len(error["loc"]) == 1
        # The section of a population has made its own suggestion.
        hint = _suggest_key(section, key) if own else separator + suggestion
        if (
            not hint
            and isinstance(error["input"], Mapping)
            and section.model_config.get("extra") == "allow"
        ):
            hint = "; if it is a section of your own population, give its file with --plugin FILE"
        kind, message = "unknown_key", f"unknown key {key!r}{hint}"
    elif kind == "literal_error" and "did you mean" not in message:
        message += _suggest_choice(error)
    elif kind in ("tuple_type", "list_type"):
        message = "expected a list in brackets, such as [1, 2]"
    return InitErrorDetails(
        type=verbatim_error(kind, message, context), loc=error["loc"], input=error["input"]
    )


def verbatim_error(
    kind: str, message: str, context: Mapping[str, Any] | None = None
) -> PydanticCustomError:
    """Return a pydantic error with this very message, which may contain braces.

    Example:
        >>> verbatim_error("unknown_key", "unknown key '{0}'").message()
        "unknown key '{0}'"
    """
    # pydantic demands a literal template and expands braces in it: the text goes in as a value.
    return PydanticCustomError(
        cast(LiteralString, kind), "{message}", {**(context or {}), "message": message}
    )


def _suggest_choice(error: ErrorDetails) -> str:
    """Return ``; did you mean ...`` with the choice most similar to the input, or nothing."""
    expected = error.get("ctx", {})["expected"]
    return did_you_mean(str(error["input"]), re.findall(r"'([^']*)'", expected))


def all_keys(section: type[BaseModel], path: str = "") -> list[str]:
    """Return the dotted keys of a section and of all sections within it.

    Example:
        >>> from neuroslam.config import SessionConfig
        >>> all_keys(SessionConfig)[:2]
        ['confirm', 'drift']
    """
    keys = []
    for name, field in section.model_fields.items():
        inner = field.annotation
        keys.append(f"{path}{name}")
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            keys += all_keys(inner, f"{path}{name}.")
    return keys


def _suggest_key(section: type[BaseModel], key: str) -> str:
    """Return ``; did you mean ...`` for an unknown key, or nothing.

    The suggestion has the same name in another section, or a similar name in the same section, or
    a similar name in any section.

    Args:
        section: Section that contains all candidates.
        key: Dotted key, relative to that section.
    """
    known = all_keys(section)
    parent, _, last = key.rpartition(".")
    same = [each for each in known if each.rpartition(".")[2] == last]
    if same:
        return f"; did you mean {' or '.join(map(repr, same[:3]))}?"
    beside = {each.rpartition(".")[2]: each for each in known if each.rpartition(".")[0] == parent}
    anywhere = {each.rpartition(".")[2]: each for each in reversed(known)}
    for names in (beside, anywhere):
        if (name := nearest(last, names)) is not None:
            return f"; did you mean {names[name]!r}?"
    return did_you_mean(key, known)
