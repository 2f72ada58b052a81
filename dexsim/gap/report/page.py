"""report.html: one page that stands alone, read in a minute. Its figures are inline SVG: no script, no network, no
font.

A class and a template each section: the class (`gap.report.sections`) says what is shown, the template (`templates/`)
how it looks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from dexsim.gap.report.sections import SECTIONS, VERDICTS

if TYPE_CHECKING:
    from dexsim.gap.report.sections import Section
    from dexsim.gap.result import Diagnosis

ENVIRONMENT = Environment(
    loader=PackageLoader("dexsim.gap.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def page(d: Diagnosis) -> str:
    """The page as HTML text."""
    shown = [text for section in SECTIONS if (text := render(section(d)))]
    return ENVIRONMENT.get_template("page.html").render(word=VERDICTS[d.data["verdict"]][0], sections=shown)


def render(section: Section) -> Markup:
    """A section as HTML; empty where it has nothing to show."""
    values = section.values()
    return Markup("") if values is None else Markup(ENVIRONMENT.get_template(section.template).render(values).strip())
