"""Sphinx's settings for the site; ``python docs/site/build.py`` uses them."""

import ast
import builtins
import importlib
import importlib.util
import inspect
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from pydantic import BaseModel
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.napoleon.docstring import GoogleDocstring

sys.path.insert(0, str(Path(__file__).parent))

import neuroslam
import neuroslam.compiled

neuroslam.compiled.compiled = lambda plain: plain  # their signatures are those of the functions

project = "neuroslam"
copyright = "The neuroslam authors, Apache-2.0"
version = release = neuroslam.__version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "mathml",
]
nitpicky = True
show_warning_types = True
suppress_warnings = ["myst.header"]  # pages that begin with a second-level heading

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
add_module_names = False
autodoc_preserve_defaults = True
napoleon_use_rtype = False
OPTIONAL = (
    "gymnasium", "mcap", "nir", "pynapple", "pynwb", "ratinabox", "ray", "rosbags", "xarray",
)  # fmt: skip
autodoc_mock_imports = [name for name in OPTIONAL if importlib.util.find_spec(name) is None]

html_theme = "furo"
html_title = f"neuroslam {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}


@cache
def module(name: str) -> ModuleType | None:
    """Import a module of the package, or return none if it is no module."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


@cache
def names_in(module_name: str) -> dict[str, str]:
    """Return the full name of all that a module imports, also for type checkers only."""
    found: dict[str, str] = {}
    home = module(module_name) if module_name.startswith("neuroslam") else None
    if home is None or home.__file__ is None:
        return found
    for node in ast.walk(ast.parse(Path(home.__file__).read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                found[alias.asname or alias.name] = f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                found[alias.asname or alias.name.partition(".")[0]] = alias.name
    return found


def home_of(dotted: str) -> str | None:
    """Return the name under which a re-exported object is documented.

    ``neuroslam.brain.NavigationBrain`` is ``neuroslam.brain.brain.NavigationBrain``.
    """
    parts = dotted.split(".")
    for n in range(len(parts), 0, -1):
        found: Any = module(".".join(parts[:n]))
        if found is None:
            continue
        if n == len(parts):
            return dotted
        target = names_in(".".join(parts[:n])).get(parts[n])
        exported = getattr(found, parts[n], None)
        if inspect.isclass(exported) or inspect.isroutine(exported):
            target = f"{exported.__module__}.{exported.__qualname__}"
        if target is None:
            return None
        return ".".join([target, *parts[n + 1 :]])
    return None


def resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Find what Sphinx does not: imported and re-exported names, and what is not of the package."""
    if node.get("refdomain") != "py":
        return None
    target, domain = node["reftarget"], env.domains["py"]
    inside = node.get("py:module") or "neuroslam"
    head, dot, rest = target.partition(".")
    known = names_in(inside).get(head)
    for name in (target, known and known + dot + rest, f"{inside}.{target}"):
        for candidate in {name, name and home_of(name)} - {None, "", target}:
            if candidate in domain.objects or candidate in domain.modules:  # type: ignore[attr-defined]
                return domain.resolve_xref(
                    env, node["refdoc"], app.builder, "obj", candidate, node, content
                )
    top = (known or target).partition(".")[0]
    if top != "neuroslam" and (hasattr(builtins, top) or importlib.util.find_spec(top)):
        return content
    last = target.rpartition(".")[2]
    if last.startswith("_") or re.fullmatch("[A-Z]", last):  # private, or a type variable
        return content
    written = isinstance(content, nodes.literal)  # by us, as a role
    return None if written else content  # aliases, parts of others' types


def whole_text(self: GoogleDocstring) -> list[str]:
    """Return the docstring of a constant; napoleon takes what is before a colon as its type."""
    return self._dedent(list(self._lines))


GoogleDocstring._parse_attribute_docstring = whole_text


def describe_fields(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Add the keys of a section of the config, which its fields describe, to its docstring."""
    if what != "class" or not (isinstance(thing, type) and issubclass(thing, BaseModel)):
        return
    own = {key: field for key, field in thing.model_fields.items() if key in thing.__annotations__}
    for key, field in own.items():
        text = (field.description or "section of its own").replace("_", r"\_")
        stated = not field.is_required() and field.default_factory is None
        if stated and not isinstance(field.default, BaseModel):
            text += f". Default: ``{field.default!r}``"
        lines += [f":param {key}: {text}."]


def plain_signature(
    app: Sphinx, what: str, name: str, thing: object, *_: object
) -> tuple[str, str] | None:
    """Leave out the signature of a config, which is the list of its keys."""
    if what == "class" and isinstance(thing, type) and issubclass(thing, BaseModel):
        return "(**keys)", ""
    return None


def is_left_out(
    app: Sphinx, what: str, name: str, thing: object, skip: bool, options: object
) -> bool | None:
    """Leave out what pydantic adds, and fields of tuples without a description of their own."""
    if name in ("model_config", "model_fields", "model_computed_fields", "model_post_init"):
        return True
    if (getattr(thing, "__doc__", None) or "").startswith("Alias for field number"):
        return True
    return None


def own_branch_only(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document | None
) -> None:
    """List all pages and the modules beside this one, not all 300 modules on each page."""
    whole = context["toctree"]
    context["toctree"] = lambda **options: whole(**options | {"collapse": True})


def setup(app: Sphinx) -> None:
    app.connect("html-page-context", own_branch_only, priority=100)  # before the theme's
    app.connect("missing-reference", resolve)
    app.connect("autodoc-process-docstring", describe_fields, priority=900)
    app.connect("autodoc-process-signature", plain_signature)
    app.connect("autodoc-skip-member", is_left_out)
