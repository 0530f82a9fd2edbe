"""Every benchmark can still be run: what it imports is there."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.benchmark.mutations import mutations

ROOT = Path(__file__).parents[2]
BENCHMARKS = sorted(path.stem for path in (ROOT / "tests" / "benchmark").glob("*.py"))


@pytest.mark.slow
def test_what_benchmarks_import_is_there():
    imports = "; ".join(f"import tests.benchmark.{name}" for name in BENCHMARKS)
    words = [sys.executable, "-c", imports]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


SOURCE = """
def wait(most, late=2):
    if late >= most and not done:
        raise ValueError(f"{late + 1} s late")
    while True:
        break
    return late
"""


def test_mutations_change_one_place_each():
    """Boundaries, operators, numbers within texts, statements, jumps and results."""
    changes = {mutant.change for mutant in mutations(SOURCE)}
    condition, raised = SOURCE.splitlines()[2].strip(), SOURCE.splitlines()[3].strip()
    assert changes == {
        ("def wait(most, late=2):", "def wait(most, late=(3)):"),
        (condition, "if (late > most) and not done:"),
        (condition, "if (late < most) and not done:"),
        (condition, "if (late >= most or not done):"),
        (condition, "if late >= most and (done):"),
        (raised, "pass"),
        (raised, "raise ValueError((f'{late - 1} s late'))"),
        (raised, "raise ValueError((f'{late + 2} s late'))"),
        (raised, "raise ValueError((f'{late + 0} s late'))"),
        ("while True:", "while (False):"),
        ("break", "continue"),
        ("return late", "return None"),
    }


def test_what_is_argued_of_mutants_is_still_so():
    """Module, tests, and the very line: whoever changes it must judge again."""
    table = yaml.safe_load((ROOT / "tests" / "benchmark" / "mutants.yaml").read_text("utf-8"))
    for module, known in table.items():
        changes = {mutant.change for mutant in mutations((ROOT / module).read_text("utf-8"))}
        assert all((ROOT / test).exists() for test in known["tests"] if test.endswith(".py"))
        for each in known.get("argued", []):
            assert (each["line"], each["becomes"]) in changes, (module, each)
            assert each["why"]
