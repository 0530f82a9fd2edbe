"""Figures as files, and as SVG within a page: texts stay texts, and nothing is fetched."""

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
from matplotlib.figure import Figure

from hilctl.analysis.plot_style import STYLE
from hilctl.base.errors import InputError
from hilctl.base.files import write_file

FORMATS = ("svg", "pdf", "png")
"""Formats of files, the vectors first."""

_DPI = 600  # of PNG files: what journals ask for of line drawings
_UNNAMED = {"Date": None, "Creator": None, "Format": None, "Type": None}
_NOT_DATED = {"svg": _UNNAMED, "pdf": {"CreationDate": None}, "png": {"Software": None}}
_METADATA = re.compile(r"<metadata>.*?</metadata>", re.DOTALL)
_GROUP = re.compile(r'<g id="[^"]*"')
_SIZE = re.compile(r'<svg[^>]*viewBox="([^"]*)"[^>]*>')
_PATH = re.compile(r'\bd="[^"]*"')
_DIGITS = re.compile(r"(\.\d\d)\d+")


def formats_of(text: str) -> tuple[str, ...]:
    """Return the formats of a list such as ``svg,pdf``.

    Raises:
        InputError: One is not known.
    """
    chosen = tuple(part.strip().lower() for part in text.split(",") if part.strip())
    unknown = [each for each in chosen if each not in FORMATS]
    if unknown or not chosen:
        got = ", ".join(unknown) or repr(text)
        raise InputError(f"--format: must be of {', '.join(FORMATS)}, commas between: {got}")
    return tuple(dict.fromkeys(chosen))


def write_figure(
    figure: Figure, folder: Path, name: str, formats: Sequence[str], *, overwrite: bool
) -> list[Path]:
    """Write a figure in some formats; each file appears whole or not at all.

    Returns:
        The files, ``NAME.FORMAT`` in the folder.

    Raises:
        InputError: One exists and may not be replaced, or can't be written.
    """
    written = []
    for chosen in formats:
        path = folder / f"{name}.{chosen}"
        content = _file(figure, chosen)

        def write(stream: BinaryIO, content: bytes = content) -> None:
            stream.write(content)

        write_file(path, write, overwrite=overwrite)
        written.append(path)
    return written


@mpl.rc_context(STYLE)
def _file(figure: Figure, chosen: str) -> bytes:
    buffer = io.BytesIO()
    metadata: Any = _NOT_DATED[chosen]
    figure.savefig(buffer, format=chosen, dpi=_DPI, metadata=metadata)
    return buffer.getvalue()


def svg(figure: Figure) -> str:
    """Return a figure as an SVG element of a page: of any width, texts as texts.

    Names of groups go, as several figures share a page; so do addresses, and digits that no screen
    and no printer shows.
    """
    buffer = io.StringIO()
    metadata: Any = _UNNAMED
    with mpl.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=metadata)
    text = buffer.getvalue()
    text = _METADATA.sub("", text[text.index("<svg") :])
    text = _SIZE.sub(r'<svg viewBox="\1" aria-hidden="true">', text, count=1)
    text = _GROUP.sub("<g", text).replace("xlink:href=", "href=")
    return _PATH.sub(lambda found: _DIGITS.sub(r"\1", found[0]), text)
