"""What the system says of files, ports and addresses, with what to do about it."""

import difflib
import errno
from collections.abc import Mapping
from pathlib import Path

REMEDIES = {
    errno.EACCES: "take a place of your own, or ask its owner; ls -l says who that is",
    errno.EPERM: "take a place of your own, or ask its owner; ls -l says who that is",
    errno.EROFS: "name a place on another file system",
    errno.ENOSPC: "df -h says where there is room",
    errno.EDQUOT: "delete what is not needed, or name a place on another file system",
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ENOTDIR: "a part of that path is a file",
    errno.EISDIR: "name a file in that folder",
    errno.EMFILE: "close some, or raise the limit: ulimit -n",
}
ADDRESS_REMEDIES = {
    errno.EACCES: "ports below 1024 are root's: take one above",
    errno.EADDRINUSE: "another program has it, ss -ltnp says which: take another port",
    errno.EADDRNOTAVAIL: "it is not this machine's: ip address lists those",
}
CONNECT_REMEDIES = {
    errno.ECONNREFUSED: "nothing listens there: is it on, and is that its port?",
    errno.EHOSTUNREACH: "is it on, is its cable in, is that its address?",
    errno.ENETUNREACH: "is this machine on that network? ip route says",
    errno.ETIMEDOUT: "is it on, is its cable in, is that its address?",
}
PORT_REMEDIES = {
    errno.EACCES: "sudo usermod --append --groups dialout $USER, and log in anew",
    errno.EBUSY: "another program has it: lsof names that",
    errno.ENOENT: "hilctl devices lists the ports of this machine",
}
"""Of serial ports."""


def reason(error: OSError, remedies: Mapping[int, str] = REMEDIES) -> str:
    """Return the system's words for an error, and what to do about it where that is known.

    Args:
        error: What was raised.
        remedies: What to do, by ``errno``.
    """
    text = error.strerror or str(error)
    remedy = remedies.get(error.errno or 0, "")
    return f"{text} ({remedy})" if remedy else text


def no_such_file(path: Path) -> str:
    """Return that there is no such file, and which one is likely to be meant."""
    if not path.parent.is_dir():
        return f"{path}: no such file (there is no folder {path.parent})"
    try:
        names = [] if path.exists() else [each.name for each in path.parent.iterdir()]
    except OSError:
        names = []
    close = difflib.get_close_matches(path.name, names, n=1, cutoff=0.75)
    return f"{path}: no such file" + (f" (did you mean '{close[0]}'?)" if close else "")
