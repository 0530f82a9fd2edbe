"""Texts from files as people may be shown them."""

MOST_SHOWN = 100
"""Characters of a name that are shown where there is room for one line."""


def printable(text: str, *, lines: bool = False) -> str:
    r"""Return a text without characters that steer a terminal, a browser or a plot.

    Control characters, such as an escape, and those that turn the direction of writing round stand
    as ``\x1b`` and ``\u202e``.

    Args:
        text: Any text.
        lines: Leave ends of lines and tabs as they are.
    """
    if text.isprintable():  # nearly always
        return text
    kept = "\n\t" if lines else ""
    return "".join(
        each if each.isprintable() or each in kept else each.encode("unicode_escape").decode()
        for each in text
    )


def short_name(text: str) -> str:
    """Return a printable text of at most :data:`MOST_SHOWN` characters."""
    name = printable(text[: MOST_SHOWN + 1])
    return name if len(name) <= MOST_SHOWN else name[: MOST_SHOWN - 3] + "..."
