"""Processors that a run may be on."""

import pytest

from hilctl.base.errors import InputError
from hilctl.run.architecture import require_ordered_memory
from hilctl.run.start import checked_experiment


@pytest.mark.parametrize("machine", ["x86_64", "AMD64"])
def test_a_processor_that_keeps_the_order_of_writes_may_run(machine):
    require_ordered_memory(machine)


@pytest.mark.parametrize("machine", ["aarch64", "riscv64", ""])
def test_any_other_is_refused_in_one_line(machine):
    with pytest.raises(InputError, match=r"x86-64 processor so far.*report, replay") as refused:
        require_ordered_memory(machine)
    assert "\n" not in str(refused.value)


def test_check_and_run_are_refused_before_the_file_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(InputError, match="this one is aarch64"):
        checked_experiment(tmp_path / "absent.yaml", [])
