"""What is put together, and what is refused before anything is served."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.options import WireFault


def test_port_in_use_is_one_line(served):
    address = served("labjack_t7")
    with pytest.raises(InputError, match=f"can't listen on {address}"):
        served("labjack_t7", port=int(address.split(":")[1]))


@pytest.mark.parametrize(("profile", "options", "words"), [
    ("waveshare_ao_8ch", {}, "has no input to show a displacement at: name a reader"),
    ("waveshare_ai_8ch", {}, "has no output to drive .*: it can be another one's reader"),
    ("adam_4024", {"reader": "kepco_bop"}, "kepco_bop: only Modbus profiles"),
    ("kepco_bop", {"reader": "labjack_t7"}, "labjack_t7: only text profiles read for Kepco"),
    ("cobs_board", {"reader": "agilent_34970a"}, "reads its own sensor: it takes no reader"),
    ("kepco_bop", {"reader": "agilent_34970a", "reader_unit_id": 2}, "are for Modbus profiles"),
    ("cobs_board", {"link": "tcp"}, "are for Modbus profiles, cobs_board has a line"),
    ("icp_m7024_dcon", {}, "has no input to show a displacement at: name a reader"),
    ("nothing", {}, "no profile 'nothing' is shipped"),
    ("cobs_board", {"faults": (WireFault("reset", at_count=1),)}, "is for tcp"),
    ("adam_4024", {"reader": "adam_4117", "sensor": "AI9"}, "4117 .* has no AI9: AI0, AI1"),
    ("adam_4024", {"reader": "adam_4117", "output": "AI0"}, "4024 .* has no AI0: AO0, AO1"),
    ("adam_4024", {"reader": "adam_4117", "reader_unit_id": 1}, "reader_unit_id must not"),
    ("wago_750", {"link": "rtu", "faults": (WireFault("reset", at_count=1),)}, "is for tcp"),
])  # fmt: skip
def test_what_can_not_be_emulated_is_refused(served, profile, options, words):
    with pytest.raises(InputError, match=words):
        served(profile, **options)


def test_second_port_in_use_leaves_nothing_open(served):
    port = int(served("labjack_t7").split(":")[1])
    with pytest.raises(InputError, match=f"listen on 127.0.0.1:{port}"):
        served("adam_6224", reader="adam_6217", reader_port=port)


def test_log_that_can_not_be_written_is_refused(served, tmp_path):
    with pytest.raises(InputError, match="can't be written"):
        served("labjack_t7", log=tmp_path / "none" / "log.jsonl")
