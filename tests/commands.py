"""Commands that tests start in processes of their own, as a user types them."""

import subprocess
import sys
from typing import Any


def typed(*words: object) -> list[str]:
    return [sys.executable, "-P", "-m", "hilctl", *map(str, words)]


def ended(command: list[str], code: int = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, which must have the exit code and no traceback."""
    options = {"timeout": 280.0, **options}
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def hilctl(*words: object, code: int = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    return ended(typed(*words), code, **options)
