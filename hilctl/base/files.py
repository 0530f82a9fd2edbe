"""Files in and out: texts, each read once and carried to whoever needs it; files written whole."""

import errno
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from hilctl.base.errors import InputError
from hilctl.base.os_errors import no_such_file, reason


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


MAX_TEXT_BYTES = 16 * 1024**2
"""Largest text that is read; a model of ten thousand parameters has a fiftieth of it."""


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return a file's text.

    Args:
        path: The file.
        max_bytes: Its largest size; looked at before any of it is read.

    Raises:
        InputError: It can't be read, is too large, or is no UTF-8 text.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a file")
        size = path.stat().st_size
        if size > max_bytes:
            limit = f"{max_bytes / 1e6:.0f} MB"
            raise InputError(
                f"{path}: has {size / 1e6:.0f} MB, more than the {limit} that are read"
            )
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(no_such_file(path)) from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except (OSError, ValueError) as error:
        why = reason(error) if isinstance(error, OSError) else error
        raise InputError(f"{path}: can't be read: {why}") from None


def sync_folder(path: Path) -> None:
    """Bring a folder to the disk: only then is the name of a new file there.

    Raises:
        OSError: The disk refuses it.
    """
    try:
        folder = os.open(path, os.O_RDONLY)
    except PermissionError:  # Windows opens no folder
        return
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # a file system without it
            raise
    finally:
        os.close(folder)


class AtomicFile:
    """A file that stands under its name whole or not at all; one not committed leaves nothing.

    It is written beside its place, with the permissions of any new file.

    Args:
        path: Its place; where it may be replaced and is a link, the file that the link leads to.
        overwrite: Whether a file of that name may be replaced.

    Attributes:
        stream: The new file, open for writing.
        final: Where it goes.

    Raises:
        FileExistsError: A file of that name exists and may not be replaced.
        OSError: The folder can't be written, or what stands there is no regular file.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._overwrite = overwrite
        self.final = path.resolve() if overwrite else path
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        if self.final.exists() and not self.final.is_file():  # a rename would replace /dev/null
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        self._beside = self.final.with_name(f".{self.final.name[:40]}-{secrets.token_hex(4)}.tmp")
        self.stream: BinaryIO = self._beside.open("xb")

    def secure(self) -> None:
        """Bring what was written to the disk, so that a committed file outlives a power cut."""
        self.stream.flush()
        os.fsync(self.stream.fileno())

    def commit(self) -> None:
        """Bring the file to the disk and put it in its place, in one step for everybody else.

        Raises:
            FileExistsError: Somebody has made a file of that name, and it may not be replaced.
            OSError: It can't be written to its end.
        """
        self.secure()
        self.stream.close()  # Windows moves and links no open file
        if self._overwrite:
            self._beside.replace(self.final)
        else:
            self._link()
        sync_folder(self.final.parent)

    def _link(self) -> None:
        try:
            self.final.hardlink_to(self._beside)  # refuses a name that is taken; a rename doesn't
        except FileExistsError:
            raise
        except OSError:  # no hard links here: claim the name, then fill it
            self.final.touch(exist_ok=False)
            try:
                self._beside.replace(self.final)
            except OSError:
                self.final.unlink()
                raise

    def close(self) -> None:
        """Close the file; where it was not committed, nothing of it is left."""
        with suppress(OSError):  # what can't be written has been reported before
            self.stream.close()
        self._beside.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


RECORDING_MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""


def begins_as_recording(path: Path) -> bool:
    """Return whether a file begins as a recording does: an empty one might become one.

    Raises:
        OSError: It can't be read.
    """
    with path.open("rb") as stream:
        head = stream.read(len(RECORDING_MAGIC))
    return head == RECORDING_MAGIC[: len(head)]


@contextmanager
def _written(path: Path, *, overwrite: bool) -> Iterator[AtomicFile]:
    try:
        if overwrite and path.is_file() and path.stat().st_size and begins_as_recording(path):
            raise InputError(f"{path}: is a recording, and nothing else replaces it: name another")
        with AtomicFile(path, overwrite=overwrite) as file:
            yield file
    except FileExistsError:
        raise already_there(path, "give another name, or --overwrite") from None
    except FileNotFoundError as error:
        lost = "" if path.parent.is_dir() else f" (there is no folder {path.parent})"
        raise InputError(f"{path}: can't be written: {error.strerror}{lost}") from None
    except OSError as error:
        raise InputError(f"{path}: can't be written: {reason(error)}") from None


def already_there(path: Path, remedy: str) -> InputError:
    """Return the refusal of a file that would be replaced; no remedy helps against a folder."""
    if path.is_dir():
        return InputError(f"{path}: is a folder: name a file in it")
    return InputError(f"{path}: exists already: {remedy}")


def write_file(path: Path, write: Callable[[BinaryIO], object], *, overwrite: bool) -> None:
    """Write a file that appears whole or not at all.

    Args:
        path: The file.
        write: Writes its content to a stream.
        overwrite: Replace a file of that name.

    Raises:
        InputError: A file of that name exists, or it can't be written.
    """
    with _written(path, overwrite=overwrite) as file:
        write(file.stream)
        file.commit()


def write_text(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a UTF-8 text file that appears whole or not at all, see :func:`write_file`."""
    write_file(path, lambda stream: stream.write(text.encode()), overwrite=overwrite)


def check_writable(path: Path, *, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse a file that could not be written, before work is done that would be in vain.

    Args:
        path: The file.
        overwrite: Whether a file of that name may be replaced.
        inputs: Files that are read for it; they are never replaced.

    Raises:
        InputError: It is one of them, or what :func:`write_file` would raise now.
    """
    check_no_input(path, inputs)
    with _written(path, overwrite=overwrite):
        pass  # not committed: nothing of it is left


def check_no_input(path: Path, inputs: Iterable[Path]) -> None:
    """Refuse an output that is an input.

    Raises:
        InputError: It is one.
    """
    for each in inputs:
        with suppress(OSError):  # one that is not there is not the other
            if path.samefile(each):
                raise InputError(f"{path}: is read by the same command: give another name")
