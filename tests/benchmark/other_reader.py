"""What a reader that others wrote makes of a recording: ``@mcap/core``."""

import json
import shutil
import subprocess
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

PEERS = Path(__file__).parents[1] / "peers"
NOT_INSTALLED = "not installed: npm ci --prefix tests/peers"
LONGEST_S = 120.0


def is_installed() -> bool:
    return shutil.which("node") is not None and (PEERS / "node_modules" / "@mcap" / "core").is_dir()


def verdict(path: Path, samples: int) -> str:
    """Return where ``@mcap/core`` differs from what we read.

    It reads the file twice, by its index and as a stream, and checks every checksum.
    """
    if not is_installed():
        return NOT_INSTALLED
    command = ["node", str(PEERS / "read_mcap.mjs"), str(path)]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        return f"no answer within {LONGEST_S:g} s"
    found = json.loads(ran.stdout)[str(path)]
    if "error" in found:
        return str(found["error"])
    ours = counts(path)
    # The topics of an axis are named after it.
    scope = sum(count for topic, count in ours.items() if topic.endswith("/scope"))
    if scope != samples:
        return f"{scope} messages in /scope, {samples} samples"
    return _difference(found, ours)


def counts(path: Path) -> dict[str, int]:
    """Return how many messages there are of each topic, as Python's mcap reads them."""
    with path.open("rb") as stream:
        return Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())


def _difference(found: dict, ours: dict[str, int]) -> str:
    for way in ("indexed", "streamed"):
        if found[way]["counts"] != ours:
            return f"{way}: {found[way]['counts']}, ours {dict(ours)}"
    if not found["streamed"]["done"] or found["streamed"]["left"]:
        return f"streamed: {found['streamed']['left']} bytes left"
    if "hilctl.end" not in found["indexed"]["metadata"]:
        return "no hilctl.end"
    return ""
