"""Parts of self-contained pages without scripts; figures are SVG elements.

Figures have the width of a journal's column and text of 8 points; on paper they are smaller, and a
page has two columns, except for tables of six columns or more, or of five with long texts. In dark
mode the lightness of figures is inverted.
"""

import html
import io
import re
from collections.abc import Iterable, Sequence

import matplotlib as mpl
from matplotlib.figure import Figure

from hilctl.base.formatting import MISSING, printable
from hilctl.lab.pages.figure_layout import UNDATED_SVG, FigureSpec, drawn
from hilctl.lab.pages.plot_style import STYLE

_METADATA = re.compile(r"<metadata>.*?</metadata>", re.DOTALL)
_GROUP = re.compile(r'<g id="[^"]*"')
_SIZE = re.compile(r'<svg[^>]*viewBox="([^"]*)"[^>]*>')
_PATH = re.compile(r'\bd="[^"]*"')
_NUMBER = re.compile(r"[-+]?[\d.,]*(e[-+]\d+)?\*?|nan|inf")  # or missing
_DIGITS = re.compile(r"(\.\d\d)\d+")

_CSS = """
:root { color-scheme: light dark; --ink: #1c1c1c; --quiet: #666; --paper: #fff; --line: #ddd;
  --pale: #f5f5f5; --note: #fff4d6; --bad: #fde4e1; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e6e6e6; --quiet: #a2a2a2; --paper: #131416; --line: #3a3c40; --pale: #1e2023;
    --note: #3d3212; --bad: #4a1d18; }
  figure svg { filter: invert(0.93) hue-rotate(180deg); }
}
html { font-size: 15px; }
body { font: 1rem/1.45 system-ui, "DejaVu Sans", sans-serif; color: var(--ink);
  background: var(--paper); max-width: 1160px; margin: 0 auto; padding: 1.2rem;
  counter-reset: figure; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 1.8rem 0 .5rem; border-bottom: 1px solid var(--line); }
.file { color: var(--quiet); margin: 0 0 1rem; overflow-wrap: anywhere; }
.headline { font-size: 1.2rem; margin: .8rem 0; }
.note, .bad { border-left: 4px solid #e69f00; padding: .5rem .8rem; background: var(--note); }
.bad { border-color: #d55e00; background: var(--bad); }
.side { columns: 29rem; column-gap: 2.5rem; margin-top: 1.8rem; }
.side section { break-inside: avoid; margin-bottom: 1.8rem; }
.side h2 { margin-top: 0; }
.figures { columns: 21.4rem; column-gap: 1.5rem; margin-top: 1rem; }
.side .figures { columns: auto; }
figure { margin: 0 0 1.2rem; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; max-width: 32rem; }
figcaption { color: var(--quiet); font-size: .9rem; max-width: 32rem; }
figcaption::before { counter-increment: figure; content: "Figure " counter(figure) ". ";
  font-weight: 600; }
table { border-collapse: collapse; margin: .3rem 0; }
th, td { text-align: left; vertical-align: top; padding: .2rem .9rem .2rem 0;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; white-space: nowrap; }
td { font-variant-numeric: tabular-nums; }
section td { overflow-wrap: anywhere; }
.number { text-align: right; }
td.number, td.word, td:first-child { white-space: nowrap; }
pre { background: var(--pale); padding: .8rem; overflow-x: auto; font-size: .87rem; }
summary { cursor: pointer; }
dt { font-weight: 600; break-after: avoid; } dd { margin: 0 0 .4rem 1rem; break-inside: avoid; }
.wide { overflow-x: auto; }
.wide th { white-space: normal; }
@media (max-width: 30rem) { th { white-space: normal; } }
@page { margin: 12mm; }
@media print { html { font-size: 8.5pt; } body { max-width: none; padding: 0; line-height: 1.3; }
  main { columns: 2; column-gap: 5mm; } .figures, .side { columns: auto; }
  h1, main > p:not(h2 ~ p), h2:has(+ .wide th:nth-child(6), + .wide .text ~ th:nth-child(5)),
  main > .wide:has(th:nth-child(6), .text ~ th:nth-child(5)) { column-span: all; }
  h2 { break-after: avoid; margin-top: 0; padding-top: 1rem; }
  tr, main > .wide:not(:has(th:nth-child(6), .text ~ th:nth-child(5))) { break-inside: avoid; }
  tr:nth-child(-n+2), tr:nth-last-child(2) { break-after: avoid; }
  th, td { padding: .1rem .6rem .1rem 0; }
  .side, .side section { margin: 0; break-inside: auto; } .figures svg { max-width: 63mm; }
  figure { margin-bottom: .6rem; }
  .wide { overflow: visible; } .wide:has(th:nth-child(10)) { font-size: 72%; }
  dt, dd { display: inline; margin: 0; } dt::after { content: ": "; }
  dd::after { content: ""; display: block; margin-bottom: .2rem; } details { display: none; } }
"""

_HEAD = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{css}</style></head><body><main>
<h1>{title}</h1>"""


def document(title: str, body: Iterable[str]) -> str:
    """Return a page with its title as heading; empty parts of the body, in HTML, are omitted."""
    head = _HEAD.format(title=text(title), css=_CSS)
    return "\n".join((head, *filter(None, body), "</main></body></html>\n"))


def text(plain: str, *, lines: bool = False) -> str:
    """Return a text as escaped HTML."""
    return html.escape(printable(plain, lines=lines))


def paragraph(plain: str, css: str = "") -> str:
    """Return a plain text as a paragraph."""
    return f'<p class="{css}">{text(plain)}</p>' if css else f"<p>{text(plain)}</p>"


def rows(heading: str, cells: Sequence[tuple[str, str]]) -> str:
    """Return a section with a table of names and values."""
    body = "\n".join(
        f"<tr><th>{text(name)}</th><td>{text(value)}</td></tr>" for name, value in cells
    )
    return section(heading, f"<table>{body}</table>")


def section(heading: str, body: str) -> str:
    """Return a section; its body is HTML."""
    return f"<section><h2>{text(heading)}</h2>{body}</section>"


def grid(headings: Iterable[str], cells: Iterable[Iterable[str]]) -> str:
    """Return a table of plain texts; columns of numbers are aligned to the right."""
    head, *body = [list(headings), *map(list, cells)]
    kinds = [_kind(column[1:]) for column in zip(head, *body, strict=True)]

    def row(tag: str, line: list[str]) -> str:
        texts = zip(kinds, map(text, line), strict=True)
        cells = (f'<{tag} class="{kind}">{cell}</{tag}>' for kind, cell in texts)
        return f"<tr>{''.join(cells)}</tr>"

    table = "\n".join((f"<thead>{row('th', head)}</thead>", *(row("td", line) for line in body)))
    return f'<div class="wide" tabindex="0"><table>{table}</table></div>'


def _kind(column: Sequence[str]) -> str:
    """Return the class of a column's cells: ``number``, ``word`` (never wrapped) or ``text``."""
    if all(map(_NUMBER.fullmatch, column)):
        return "number"
    return "text" if any(" " in cell for cell in column) else "word"


def figures(sheets: Iterable[FigureSpec]) -> str:
    """Return figures with captions, side by side if there is room; nothing without any."""
    blocks = "\n".join(
        f"<figure>{svg(drawn(sheet), text(sheet.caption))}"
        f"<figcaption>{text(sheet.caption)}</figcaption></figure>"
        for sheet in sheets
    )
    return f'<div class="figures">{blocks}</div>' if blocks else ""


def results(
    sheets: Iterable[FigureSpec],
    heading: str,
    tables: Sequence[tuple[str, Iterable[tuple[str, str]]]],
    sections: Sequence[str] = (),
) -> list[str]:
    """Return figures, named tables of names and values, and further sections, in two columns.

    Several tables become one of the full width.
    """
    if len(tables) == 1:
        sections = [rows(heading, list(tables[0][1])), *sections]
    beside = [figures(sheets)]
    if sections:
        beside = ['<div class="side">', *beside, *sections, "</div>"]
    if len(tables) == 1:
        return beside
    known = [dict(table) for _, table in tables]
    keys = dict.fromkeys(key for table in known for key in table)
    cells = [(key, *(table.get(key, MISSING) for table in known)) for key in keys]
    return [*beside, section(heading, grid(("quantity", *(name for name, _ in tables)), cells))]


def svg(figure: Figure, alternative: str) -> str:
    """Return a figure as an SVG element of any width, with text as text.

    ``alternative`` is its alternative text as HTML.

    Ids of groups are removed because figures share a page, and so are URLs and invisible digits.
    """
    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=UNDATED_SVG)
    text = buffer.getvalue()
    text = _METADATA.sub("", text[text.index("<svg") :])
    named = f'role="img" aria-label="{alternative}"'
    text = _SIZE.sub(lambda found: f'<svg viewBox="{found[1]}" {named}>', text, count=1)
    text = _GROUP.sub("<g", text).replace("xlink:href=", "href=")
    return _PATH.sub(lambda found: _DIGITS.sub(r"\1", found[0]), text)


def details(heading: str, plain: str) -> str:
    """Return a collapsed text."""
    return folded(heading, [f"<pre>{text(plain, lines=True)}</pre>"])


def folded(heading: str, body: Iterable[str]) -> str:
    """Return a collapsed part of a page; its body is HTML."""
    return f"<details><summary>{text(heading)}</summary>{''.join(body)}</details>"


def definitions(*terms: str) -> str:
    """Return the definitions of terms in the order of the list; empty without any."""
    known = (each for each in DEFINITIONS.items() if each[0] in terms)
    body = "".join(f"<dt>{text(term)}</dt><dd>{text(meaning)}</dd>" for term, meaning in known)
    return f"<h2>Definitions</h2><dl>{body}</dl>" if body else ""


DEFINITIONS = {
    "average cycle": (
        "Mean of all complete steady cycles in bins of phase. All metrics are computed from it, "
        "except those of single samples."
    ),
    "peak hysteresis": (
        "Largest difference of displacement between a rising and a falling branch at one input, "
        "over the peak-to-peak displacement. The input is the reference with a compensator, "
        "otherwise the command."
    ),
    "noise floor": "Peak hysteresis that sensor noise alone would cause.",
    "loop area": "Area enclosed by displacement against input.",
    "peak and rms error": (
        "Displacement less reference, offset included: largest magnitude, and root mean square, "
        "over the peak-to-peak reference."
    ),
    "contour error": (
        "Distance of the measured point from the nearest point of the reference path around the "
        "sample's reference. The error along the path, from the reference to the nearest point, "
        "is listed separately; it is negative if the axes lag."
    ),
    "asymmetry": (
        "Difference of the highest and the lowest displacement from rest, over the peak-to-peak."
    ),
    "model error": (
        "Largest difference of the measured and the modelled displacement, over the "
        "peak-to-peak displacement."
    ),
    "coherence": (
        "Share of the output's power that a linear response to the input explains, per frequency."
    ),
    "lines not excited": (
        "Output between the excited frequencies of a multisine, rms per line, in percent of the "
        "excited lines: above the noise it is nonlinear distortion, at even and odd multiples of "
        "the lowest common frequency."
    ),
    "noise density": (
        "Amplitude per root of bandwidth, from averaged spectra (Welch, Hann window): its median, "
        "so without lines, over all frequencies or the octave at one."
    ),
    "Allan deviation": (
        "Root of half the mean square difference of neighbouring means, by their averaging time: "
        "white noise falls with the root of the time, drift rises."
    ),
    "bias instability": (
        "Lowest Allan deviation over 0.664: best repeatability of a mean. An upper bound if the "
        "deviation still falls at the longest time."
    ),
    "THD": (
        "Total harmonic distortion: root of the sum of squares of the harmonics 2 to 20, over the "
        "fundamental."
    ),
    "harmonics of the error": (
        "Amplitudes of the error's steady part at multiples of the waveform's frequency."
    ),
    "r²": "Share of the variance explained by a linear fit.",
    "lateness": "Time from a tick's deadline to its exchange; 99 % of the ticks are within p99.",
    "busy": "Time from a tick's deadline to the end of its exchange; the rest of a tick is left.",
    "mean tick": "Mean time to wake after the deadline, to compute, and to exchange the block.",
}
