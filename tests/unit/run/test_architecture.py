"""Computers that a run may be on."""

import pytest

from hilctl.base.errors import InputError
from hilctl.run.architecture import require_real_time_machine
from hilctl.run.detached import start_detached
from hilctl.run.start import checked_experiment, start_run


@pytest.mark.parametrize("machine", ["x86_64", "AMD64"])
def test_a_processor_that_keeps_the_order_of_writes_may_run(machine):
    require_real_time_machine(machine)


@pytest.mark.parametrize("machine", ["aarch64", "riscv64", ""])
def test_any_other_is_refused_in_one_line(machine):
    with pytest.raises(InputError, match=r"x86-64 processor so far.*report, replay") as refused:
        require_real_time_machine(machine)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_another_system_is_refused_in_one_line(system):
    with pytest.raises(InputError, match=f"needs Linux, this is {system}: report, replay") as no:
        require_real_time_machine("x86_64", system)
    assert "\n" not in str(no.value)


def test_runs_are_refused_before_the_file_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    absent = tmp_path / "absent.yaml"
    with pytest.raises(InputError, match="this one is aarch64"):
        start_run(absent, [], None, overwrite=False, on_progress=print)
    with pytest.raises(InputError, match="this one is aarch64"):
        start_detached(absent, [], None, [])
    with pytest.raises(InputError, match=r"absent\.yaml"):  # an experiment can be checked
        checked_experiment(absent, [])
