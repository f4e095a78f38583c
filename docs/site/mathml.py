"""Formulas as MathML, made at build time: pages need no script and no network to show them."""

import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

LOGGER = logging.getLogger(__name__)


def to_mathml(formula: str, display: str) -> str:
    """Convert LaTeX to MathML.

    Raises:
        ExtensionError: If a command is left in the result, or the formula is malformed.
    """
    text = re.sub(r"\\(?:Bigg?|bigg?)[lr]?\s*(?=\\[lr]?[Vv]ert)", "", formula)
    text = re.sub(r"\\arg(?![a-z])(?:\\!)?", r"\\operatorname{arg}", text)
    if "\\\\" in text and "\\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    try:
        made = convert(text, display=display)
    except Exception as error:
        raise ExtensionError(f"formula {formula!r}: {error!r}") from error
    if left := re.search(r">\\[A-Za-z]+", made):
        raise ExtensionError(f"formula {formula!r}: {left[0][1:]} is not known")
    return made


def checked(node: nodes.Element, display: str) -> str:
    try:
        return to_mathml(node.astext(), display)
    except ExtensionError as error:
        LOGGER.warning("%s", error, location=node, type="math")
        return ""


def visit_inline(self: HTML5Translator, node: nodes.math) -> None:
    self.body.append(checked(node, "inline"))
    raise nodes.SkipNode


def visit_block(self: HTML5Translator, node: nodes.math_block) -> None:
    self.body.append(self.starttag(node, "div", CLASS="math"))
    self.body.append(checked(node, "block"))
    self.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
