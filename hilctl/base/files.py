"""Read text files once, write files atomically, and describe OS errors with a fix."""

import errno
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from hilctl.base.errors import InputError
from hilctl.base.formatting import did_you_mean


class TextFiles:
    """Text files that are read from disk once.

    The loop process receives the texts that the check has read, so that it uses the checked files.

    Attributes:
        texts: The text of each file read so far, by its absolute path.

    Args:
        texts: Texts read before; other files are then rejected.
    """

    def __init__(self, texts: Mapping[str, str] | None = None) -> None:
        self._sealed = texts is not None
        self.texts: dict[str, str] = dict(texts or {})

    def read(self, path: Path) -> str:
        """Return a file's text; raise InputError if it is not UTF-8, or was not read before."""
        key = os.path.abspath(path)  # noqa: PTH100  a link stays the link that was named
        if key not in self.texts:
            if self._sealed:
                raise InputError(f"{path}: was not read when the experiment was checked")
            self.texts[key] = read_text(path)
        return self.texts[key]


MAX_TEXT_BYTES = 16 * 1024**2
"""Largest text file; a model of ten thousand parameters is fifty times smaller."""


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a UTF-8 file; raise InputError as :func:`read_bytes` does."""
    try:
        return read_bytes(path, max_bytes).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None


def exists(path: Path) -> bool:
    """Return whether a path exists; unlike Path.exists, never raise OSError."""
    return os.path.exists(path)  # noqa: PTH110


def is_file(path: Path) -> bool:
    """Return whether a path is a file; unlike Path.is_file, never raise OSError."""
    return os.path.isfile(path)  # noqa: PTH113


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder; unlike Path.is_dir, never raise OSError."""
    return os.path.isdir(path)  # noqa: PTH112


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Return the content of a file; raise InputError if it cannot be read, or is too large."""
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a file")
        size = path.stat().st_size
        if size > max_bytes:
            limit = f"{max_bytes / 1e6:.0f} MB"
            raise InputError(f"{path}: has {size / 1e6:.0f} MB, more than the limit of {limit}")
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(no_such_file(path)) from None
    except (OSError, ValueError) as error:
        why = reason(error) if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read: {why}") from None


def open_binary(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file for reading; raise OSError if it is a pipe (which would wait) or a device."""
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return path.open("rb", buffering)


def sync_folder(path: Path) -> None:
    """Flush a folder to the disk, so that the name of a new file survives a power cut."""
    try:
        folder = os.open(path, os.O_RDONLY)
    except PermissionError:  # Windows cannot open folders
        return
    try:
        os.fsync(folder)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # not supported by the file system
            raise
    finally:
        os.close(folder)


class AtomicFile:
    """A file that appears complete or not at all.

    It is written under a temporary name in the same folder, and discarded unless committed. If it
    may be replaced and is a link, the target of the link is replaced.

    Attributes:
        stream: The new file, open for writing.
        final: Its final path.

    Raises:
        FileExistsError: A file of that name exists and may not be replaced.
        OSError: The folder cannot be written, or the path is not a regular file.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._overwrite = overwrite
        self.final = Path(os.path.realpath(path)) if overwrite else path
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        if self.final.exists() and not self.final.is_file():  # a rename would replace /dev/null
            raise OSError(errno.EINVAL, "Not a regular file", str(path))
        self._beside = self.final.with_name(f".{self.final.name[:40]}-{secrets.token_hex(4)}.tmp")
        self.stream: BinaryIO = self._beside.open("xb")

    def secure(self) -> None:
        """Flush the content to the disk, so that a committed file survives a power cut."""
        self.stream.flush()
        os.fsync(self.stream.fileno())

    def commit(self) -> None:
        """Flush the file to the disk and move it to its place atomically.

        Raises:
            FileExistsError: A file of that name exists and may not be replaced.
            OSError: The file cannot be written.
        """
        self.secure()
        self.stream.close()  # Windows cannot move an open file
        if self._overwrite:
            self._beside.replace(self.final)
        else:
            self._link()
        sync_folder(self.final.parent)

    def _link(self) -> None:
        try:
            self.final.hardlink_to(self._beside)  # fails if the name exists, unlike a rename
        except FileExistsError:
            raise
        except OSError:  # no hard links: create the name, then replace it
            self.final.touch(exist_ok=False)
            try:
                self._beside.replace(self.final)
            except OSError:
                self.final.unlink()
                raise

    def close(self) -> None:
        """Close the file; discard it unless committed."""
        with suppress(OSError):  # write errors were reported before
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
    """Return whether a file begins like a recording; an empty one does."""
    with path.open("rb") as stream:
        head = stream.read(len(RECORDING_MAGIC))
    return head == RECORDING_MAGIC[: len(head)]


@contextmanager
def _written(path: Path, *, overwrite: bool) -> Iterator[AtomicFile]:
    try:
        if overwrite and path.is_file() and path.stat().st_size and begins_as_recording(path):
            raise InputError(f"{path}: is a recording, which is never replaced: use another name")
        with AtomicFile(path, overwrite=overwrite) as file:
            yield file
    except FileExistsError:
        raise already_there(path, "choose another name, or overwrite") from None
    except FileNotFoundError as error:
        lost = "" if path.parent.is_dir() else f" (there is no folder {path.parent})"
        raise InputError(f"{path}: cannot be written: {error.strerror}{lost}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {reason(error)}") from None


def already_there(path: Path, remedy: str) -> InputError:
    """Return the error for an existing file, with its fix unless it is a folder."""
    if path.is_dir():
        return InputError(f"{path}: is a folder: specify a file in it")
    return InputError(f"{path}: exists already: {remedy}")


def write_file(path: Path, write: Callable[[BinaryIO], object], *, overwrite: bool) -> None:
    """Write a file atomically; raise InputError if it exists or cannot be written."""
    with _written(path, overwrite=overwrite) as file:
        write(file.stream)
        file.commit()


def write_text(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a UTF-8 text file atomically, see :func:`write_file`."""
    write_file(path, lambda stream: stream.write(text.encode()), overwrite=overwrite)


def check_writable(path: Path, *, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if :func:`write_file` would fail now, or a file is one of the inputs."""
    check_no_input(path, inputs)
    with _written(path, overwrite=overwrite):
        pass  # not committed, so discarded


def check_no_input(path: Path, inputs: Iterable[Path]) -> None:
    """Raise InputError if an output is also an input."""
    for each in inputs:
        with suppress(OSError):  # a missing file is not an input
            if path.samefile(each):
                raise InputError(f"{path}: is an input of the same command: use another name")


REMEDIES = {
    errno.EACCES: "use another path, or ask the owner of this one (ls -l)",
    errno.EPERM: "use another path, or ask the owner of this one (ls -l)",
    errno.EROFS: "use another file system",
    errno.ENOSPC: "df -h lists free space",
    errno.EDQUOT: "delete files, or use another file system",
    errno.ENAMETOOLONG: "use a shorter name",
    errno.ENOTDIR: "a part of that path is a file",
    errno.EISDIR: "specify a file in that folder",
    errno.EMFILE: "close some, or raise the limit: ulimit -n",
}
ADDRESS_REMEDIES = {
    errno.EACCES: "ports below 1024 need root: use a higher one",
    errno.EADDRINUSE: "another program uses it (ss -ltnp): use another port",
    errno.EADDRNOTAVAIL: "not an address of this machine: ip address lists them",
}
CONNECT_REMEDIES = {
    errno.ECONNREFUSED: "is the device on, and is the port right?",
    errno.EHOSTUNREACH: "is the device on and connected, and is the address right?",
    errno.ENETUNREACH: "is this machine on that network? see ip route",
    errno.ETIMEDOUT: "is the device on and connected, and is the address right?",
}
PORT_REMEDIES = {
    errno.EACCES: "sudo usermod --append --groups dialout $USER, and log in again",
    errno.EBUSY: "another program uses it: lsof lists it",
    errno.ENOENT: "hilctl devices lists the ports of this machine",
}
"""Fixes for serial ports."""


def reason(error: OSError, remedies: Mapping[int, str] = REMEDIES) -> str:
    """Return the text of an OS error, with a fix if one is known by its ``errno``."""
    number = error.errno or 0
    if remedy := remedies.get(number):
        return f"{os.strerror(number)} ({remedy})"  # libraries add details to strerror
    return error.strerror or str(error)


def make_folder(path: Path) -> None:
    """Create a folder and its parents where missing; raise InputError if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {path}: {reason(error)}") from None


def no_such_file(path: Path) -> str:
    """Return the message for a missing file, with the closest existing name."""
    if not path.parent.is_dir():
        return f"{path}: no such file (there is no folder {path.parent})"
    if path.is_symlink():
        return f"{path}: no such file (it is a link to {path.readlink()})"
    try:
        found = [] if path.exists() else list(path.parent.iterdir())
    except OSError:
        found = []
    if path.suffix:  # model.html is not meant by model.yaml
        found = [each for each in found if did_you_mean(path.suffix, [each.suffix], listed=True)]
    names = [each.name for each in found]
    hint = did_you_mean(path.name, names, listed=True)  # a folder may have many
    return f"{path}: no such file" + (f" ({hint})" if hint else "")
