"""Systems that a run may be on."""

from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.run import architecture
from hilctl.run.architecture import require_linux
from hilctl.run.detached import start_detached
from hilctl.run.start import checked_experiment, start_run


@pytest.mark.parametrize("machine", ["x86_64", "aarch64", "riscv64"])
def test_linux_may_run_on_any_processor(monkeypatch, machine):
    monkeypatch.setattr("platform.machine", lambda: machine)
    require_linux()


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_another_system_is_refused_in_one_line(monkeypatch, system):
    monkeypatch.setattr(architecture, "sys", SimpleNamespace(platform=system))
    with pytest.raises(InputError, match=f"needs Linux, this is {system}: report, replay") as no:
        require_linux()
    assert "\n" not in str(no.value)


def test_runs_are_refused_before_the_file_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr(architecture, "sys", SimpleNamespace(platform="darwin"))
    absent = tmp_path / "absent.yaml"
    with pytest.raises(InputError, match="needs Linux"):
        start_run(absent, [], None, overwrite=False, on_progress=print)
    with pytest.raises(InputError, match="needs Linux"):
        start_detached(absent, [], None, [])
    with pytest.raises(InputError, match=r"absent\.yaml"):  # an experiment can be checked
        checked_experiment(absent, [])
