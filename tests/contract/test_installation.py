"""hilctl is imported from its installation, even in the folder that contains its clone."""

import json
import subprocess
import sys

SCRIPT = """
import importlib.util, json
import hilctl, hilctl_drivers
from hilctl import api
found = [importlib.util.find_spec(name) for name in ("tests.own", "tests.fakes")]
print(json.dumps([hilctl.__version__, *(spec and spec.origin for spec in found)]))
"""


def test_clone_beside_a_script_does_not_hide_the_package(tmp_path):
    (tmp_path / "hilctl" / "hilctl").mkdir(parents=True)
    script = tmp_path / "analysis.py"
    script.write_text(SCRIPT, encoding="utf-8")
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr


def test_packages_of_a_script_come_before_those_of_the_clone(tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "__init__.py").touch()
    own = tmp_path / "tests" / "own.py"
    own.touch()
    script = tmp_path / "analysis.py"
    script.write_text(SCRIPT, encoding="utf-8")
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path)
    assert json.loads(ran.stdout)[1:] == [str(own), None], ran.stderr
