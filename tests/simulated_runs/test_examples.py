"""The scripts of ``examples/`` run unchanged, with the documented output and files."""

import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = Path(__file__).parents[2] / "examples"
# What the text they print must match, figures within what the simulated rig allows, and files.
EXPECTED = {
    "first_run": (r"peak hysteresis 3\d\.\d % of 8\d\.\d µm", "first-run/loop.svg"),
    "find_a_model": (r"peak hysteresis \d\.\d\d %", "find-a-model/model.yaml"),
    "before_and_after": (
        r"before: 3\d\.\d+ % .*\nafter: [01]\.\d+ %", "before-and-after/before_and_after.svg",
    ),
    "learn": (r"run 0: .*[\s\S]*\n0\.\d+ % peak error", "learn/correction.yaml"),
    "campaign_to_figure": (
        r"(?s)step 1 .*completed.*amplitudes\.csv.*\.mcap\n.*\.mcap", "campaign/figures",
    ),
    "own_study": (
        r"A: .*\(run\)[\s\S]*60 µm need \d\.\d+ A\n(\d.*\(done earlier\)\n)+", "own-study",
    ),
    "matlab_handover": (r"run\.mat: \d+ samples[\s\S]*\nTrue", "handover/run.npz"),
}  # fmt: skip
NOTEBOOK = EXAMPLES / "run_to_c.ipynb"
MOST_LINES = 40
CELL = re.compile(r"^# %%", re.MULTILINE)


def test_each_is_expected_and_listed():
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert names == set(EXPECTED)
    listed = (EXAMPLES / "README.md").read_text()
    assert all(f"`{name}.py`" in listed for name in names)
    assert [*EXAMPLES.glob("*.ipynb")] == [NOTEBOOK]
    assert f"`{NOTEBOOK.name}`" in listed


@pytest.mark.parametrize("name", EXPECTED)
def test_example(name, tmp_path):
    text, written = EXPECTED[name]
    script = EXAMPLES / f"{name}.py"
    assert len(CELL.findall(script.read_text())) >= 3
    ended = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        cwd=tmp_path, env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True, text=True, check=False, timeout=480.0,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert re.search(text, ended.stdout), ended.stdout
    assert (tmp_path / "examples-out" / written).exists()


def shown(output):
    """Return the text that a reader of a notebook sees of an output."""
    return output.text if output.output_type == "stream" else output.data["text/plain"]


def test_notebook_runs_with_short_outputs(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in cells)
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    for cell in cells:
        for output in cell.outputs:
            assert output.get("name") != "stderr", output.text
            assert len(shown(output).splitlines()) <= MOST_LINES
    assert (tmp_path / "examples-out" / "notebook" / "piezo.c").exists()
