"""Equations as MathML, which browsers draw themselves: no script, nothing from the network."""

from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx


def _mathml(text: str, *, as_block: bool) -> str:
    """Return an equation; a dot that is no accent stands above its letter, whatever the font.

    Some fonts have accents so low that browsers draw them into the letter.
    """
    found: str = tex2mathml(text, as_block=as_block)
    return found.replace('<mover accent="true">', "<mover>")


def _inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _displayed(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(
        f'<div class="equation" tabindex="0">{_mathml(node.astext(), as_block=True)}</div>'
    )
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Make it the writer of equations."""
    app.add_html_math_renderer("mathml", (_inline, None), (_displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
