"""Run the commands of a document in order, and compare their output with the document.

``python -m tests.documents.walkthrough README.md docs/tutorial.md`` uses a new clone with nothing
installed and an empty environment. Blocks of ``sh`` and ``python`` are run; a block of ``text``
after one is its output, with ``...`` for any text, in a line of its own for any lines.
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCED = re.compile(r"^```(sh|python|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MARK = "=== step"
NOT_HERE = ("make test", "make docs")
"""Lines that are omitted, because they take long and CI runs them separately."""


@dataclass
class Step:
    """Commands of a document, and their expected output, if any."""

    script: str
    expected: str = ""


def steps_of(document: str) -> list[Step]:
    steps: list[Step] = []
    for kind, text in FENCED.findall(document):
        if kind == "text":
            steps[-1].expected = text
        elif kind == "python":
            steps.append(Step(f"python - <<'END'\n{text}END\n"))
        else:
            lines = [line for line in text.splitlines() if not line.startswith(NOT_HERE)]
            steps.append(Step("\n".join(lines) + "\n"))
    return steps


def pattern(expected: str) -> re.Pattern[str]:
    """Return the pattern of an expected output, with ``...`` for any text or lines."""
    lines = []
    for line in expected.splitlines():
        if line.strip() == "...":
            lines.append(r"(?:.*\n)*?")
        else:
            lines.append(".*".join(map(re.escape, line.rstrip().split("..."))) + r"\n")
    return re.compile("^" + "".join(lines), re.MULTILINE)


def walk(document: str, folder: Path, environment: dict[str, str]) -> list[str]:
    """Run a document's commands in a copy of the repository; return a text per wrong step."""
    steps = steps_of(document)
    script = "".join(f"echo '{MARK} {i}'\n{step.script}" for i, step in enumerate(steps))
    ended = subprocess.run(
        ["bash", "-e", "-c", script],
        cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, check=False, timeout=1800,
    )  # fmt: skip
    printed = re.split(rf"^{MARK} \d+\n", ended.stdout, flags=re.MULTILINE)[1:]
    wrong = [
        f"step {i}:\n{step.script}printed\n{text}\nnot\n{step.expected}"
        for i, (step, text) in enumerate(zip(steps, printed, strict=False))
        if not pattern(step.expected).search(re.sub(r"[ \t]+$", "", text, flags=re.MULTILINE))
    ]
    if ended.returncode or len(printed) < len(steps):
        last = f"{steps[len(printed) - 1].script}{printed[-1]}" if printed else ended.stdout
        wrong.append(f"exit code {ended.returncode} at step {len(printed) - 1}:\n{last}")
    return wrong


def main() -> int:
    """Walk through documents in a new clone; return the exit code."""
    wrong = []
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "hilctl"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        kept = {name: os.environ[name] for name in ("PATH", "LANG") if name in os.environ}
        environment = {**kept, "HOME": folder, "HILCTL_RUNS": f"{folder}/runs"}
        for name in sys.argv[1:]:
            found = walk((clone / name).read_text(encoding="utf-8"), clone, environment)
            print(f"{name}: {len(found)} wrong", flush=True)
            wrong += found
            subprocess.run(shlex.split("git clean --quiet --force -x -d -e .venv"), cwd=clone)
    print("\n\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
