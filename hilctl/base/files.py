"""Text files that an experiment refers to, each read once and carried to whoever needs it."""

import os
from collections.abc import Mapping
from pathlib import Path

from hilctl.base.errors import InputError


class TextFiles:
    """Text files, each read from disk the first time it is asked for, and never again.

    What was checked is what runs: the loop's process gets the texts that the check has read, and
    reads nothing from disk itself.

    Attributes:
        texts: The text of each file read so far, by its absolute path.

    Args:
        texts: Files that were read before; then no others may be asked for.
    """

    def __init__(self, texts: Mapping[str, str] | None = None) -> None:
        self._sealed = texts is not None
        self.texts: dict[str, str] = dict(texts or {})

    def read(self, path: Path) -> str:
        """Return a file's text.

        Raises:
            InputError: It can't be read, is no UTF-8 text, or is not among the files given.
        """
        key = os.path.abspath(path)  # noqa: PTH100  a link stays the link that was named
        if key not in self.texts:
            if self._sealed:
                raise InputError(f"{path}: was not read when the experiment was checked")
            self.texts[key] = read_text(path)
        return self.texts[key]


def read_text(path: Path) -> str:
    """Return a file's text.

    Raises:
        InputError: It can't be read, or is no UTF-8 text.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a file")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: can't be read: {reason}") from None
