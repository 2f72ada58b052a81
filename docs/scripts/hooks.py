"""MkDocs hooks: generated tables where a page says `<!-- GENERATED: name -->`; equations as MathML, without a script.

An equation is a fenced block of the language `math`, or $`...`$ within a line, in LaTeX; both show on GitHub too.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from latex2mathml.converter import convert

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import reference  # noqa: E402


def on_post_build(config: dict, **_: object) -> None:
    """Write llms.txt, the list of pages for assistants, into the site."""
    (Path(config["site_dir"]) / "llms.txt").write_text(reference.llms(), encoding="utf-8")


GENERATED = re.compile(r"^<!-- GENERATED: (\w+) -->$", re.M)
BLOCK = re.compile(r"^```math\n(.*?)\n```$", re.M | re.S)
INLINE = re.compile(r"\$`([^`\n]+)`\$")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Return a page's Markdown before it is rendered. Raises KeyError for a generated table that does not exist."""
    markdown = GENERATED.sub(lambda m: reference.PAGES[m[1]](), markdown)
    markdown = BLOCK.sub(
        lambda m: "".join(f"<p>{convert(line, display='block')}</p>\n" for line in m[1].split("\\\\\n")), markdown
    )
    return INLINE.sub(
        lambda m: f"<span>{convert(m[1])}</span>", markdown
    )  # a line that begins with <math> would be a block
