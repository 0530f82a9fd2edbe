"""``serial_dac`` through a board's FIFO, against an emulated board with a clock of its own."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl.base.samples import BlockHeader, Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import SystemClock
from hilctl_drivers.board.board_session import exchange_time
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from hilctl_drivers.transport.framing import binary_framing
from tests.fakes import FakeHost, loop_plan, made_safe
from tests.unit.drivers.conftest import TIMEOUT_S

pytestmark = pytest.mark.slow  # the board's FIFO runs empty in real time

RATE_HZ = 2_500.0
BLOCK = 100
FIFO_BLOCKS = 5  # 200 ms, which a busy machine may take for itself


@pytest.fixture
def board(no_boot, serial_bench):
    """Return a function that wires a streaming device to an emulated board."""
    made = {"timeout_s": TIMEOUT_S, "fifo_blocks": FIFO_BLOCKS, "noise": False}

    def of(**options):
        profile = no_boot("cobs_board_fifo")
        return serial_bench(profile, rate_hz=RATE_HZ, block=BLOCK, **{**made, **options})

    return of


def hold(driven, command, blocks):
    return [driven.exchange(command) for _ in range(blocks)]


def sine(n):
    return 3.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE_HZ)


def test_each_displacement_belongs_to_its_command(board):
    driven = board()
    driven.open()
    commands = sine(20 * BLOCK)
    back = [driven.exchange(part) for part in np.split(commands, 20)]
    assert np.isnan(np.concatenate(back[:FIFO_BLOCKS])).all()
    found = np.concatenate(back[FIFO_BLOCKS:])
    actuator = TerfenolActuator(replace(TerfenolParameters(), sensor_noise_um=0.0), RATE_HZ)
    expected, measured = np.empty(found.size), np.empty(found.size)
    sent = commands[: found.size].astype(np.float32).astype(np.float64)
    actuator.step(sent, expected, measured)
    assert found == pytest.approx(expected, abs=1e-5)


def test_the_board_keeps_the_pace(board):
    driven = board()
    driven.open()
    hold(driven, 1.0, FIFO_BLOCKS)
    assert driven.emulator.device.fifo.played < BLOCK
    start = time.monotonic()
    hold(driven, 1.0, 10)
    assert time.monotonic() - start > 0.9 * 10 * BLOCK / RATE_HZ
    assert driven.device.wire.fifo_level_min > BLOCK  # a busy machine takes some for itself


def test_a_stall_of_this_machine_costs_fifo_and_no_sample(board):
    driven = board(fifo_blocks=30)  # 1.2 s, of which a busy machine may take most for itself
    driven.open()
    hold(driven, 1.0, 35)
    driven.pass_s(0.2)
    assert all(np.isfinite(each).all() for each in hold(driven, 1.0, 15))
    assert driven.emulator.device.fifo.underruns == 0
    driven.device.close()


def test_an_underrun_is_told_with_its_length(board):
    driven = board()
    driven.open()
    hold(driven, 1.0, 10)
    driven.pass_s(0.32)
    with pytest.raises(DeviceError, match=r"underrun: .* (\d+) sample") as e:
        hold(driven, 1.0, 1)
    told = int(re.search(r"(\d+) sample", str(e.value))[1])
    assert 200 <= told <= 5000  # and what a busy machine takes for itself
    driven.device.make_safe(0.0)
    assert driven.events()[-1]["event"] == "safe"


@pytest.mark.parametrize(("fault", "text"), [
    ("silence", f"no answer within {TIMEOUT_S + 0.04:g} s"),
    ("corrupt", "crc16_ccitt_false|not a COBS frame|behind the final"),
    ("cut", f"within {TIMEOUT_S + 0.04:g} s"),
    ("duplicate", "bytes"),
    ("wrong_id", "reply 91 to message"),
    ("exception", "refused by the board"),
])  # fmt: skip
def test_a_bad_answer_is_an_error_and_the_output_can_still_be_made_safe(board, fault, text):
    driven = board(faults=[f"{fault}@15"], fifo_blocks=15)
    driven.open()
    with pytest.raises(DeviceError, match=text):
        hold(driven, 2.0, 20)
    made_safe(driven.device, 0.0)
    last = driven.events()[-1]
    assert (last["event"], last["current_a"]) == ("safe", 0.0)
    driven.open()
    hold(driven, 0.0, 8)


def test_a_silent_host_is_noticed_by_the_board(board):
    driven = board(watchdog={"timeout_s": 0.2, "safe_command": -1.0})
    driven.open()
    hold(driven, 2.0, 10)
    driven.pass_s(0.2)
    with pytest.raises(DeviceError, match="watchdog has tripped"):
        hold(driven, 2.0, 1)
    last = driven.events()[-1]
    assert (last["event"], last["current_a"]) == ("watchdog", -1.0)


def test_samples_follow_one_another(board):
    driven = board()
    driven.open()
    hold(driven, 1.0, 2)
    driven.sent += BLOCK
    with pytest.raises(DeviceError, match=r"200 .* got 300"):
        hold(driven, 1.0, 1)


@pytest.mark.parametrize(("rate_hz", "block", "options", "text"), [
    (RATE_HZ, 513, {}, "block must be 1 to 512 samples, got 513"),
    (RATE_HZ, 500, {"fifo_blocks": 16}, "must fit into the FIFO, 8192 samples, got 500"),
    (50.0, 10, {}, r"sample rate must be in \[100, .*got 50"),
    (200_000.0, 500, {}, r"sample rate must be in \[100, 100000\] Hz"),
    (RATE_HZ, 500, {"watchdog": {"timeout_s": 0.1}}, "3 exchanges must come within"),
])  # fmt: skip
def test_what_the_fifo_can_not_do_is_refused_at_open(board, rate_hz, block, options, text):
    driven = board(**options)
    with pytest.raises(DeviceError, match=text):
        driven.device.open(rate_hz, block)
    assert driven.events() == []


def run_loop(driven, n):
    """Run a sine of n samples through the real loop; return its outcome and what it recorded."""
    host = FakeHost(SystemClock(), BLOCK)
    limits = CommandLimits(low=-5.0, high=5.0, slew_per_s=1e5, safe=0.0, ramp_per_s=1e3)
    driven.open()
    plan = loop_plan(
        reference=sine(n),
        input_um=sine(n),
        block=BLOCK,
        latency_blocks=driven.device.info.latency_blocks,
        sample_rate_hz=RATE_HZ,
        compensator=Compensator(None, RATE_HZ),
        limits=limits,
        interlocks=InterlockContext(stroke_um=(-100.0, 100.0)),
        late_policy="follow",
    )
    return Loop(plan, [driven.device], host).run(host.clock.now_ns()), host


def test_a_whole_run_loses_nothing(board):
    driven = board(noise=True, fifo_blocks=30)  # 1.2 s: a busy machine stalls for more than 0.2 s
    outcome, host = run_loop(driven, 5_050)
    assert (outcome.code, outcome.safe) == ("completed", True)
    firsts = [head[BlockHeader.FIRST_SAMPLE] for head in host.heads]
    assert firsts == list(range(0, outcome.ended_at, BLOCK))
    columns = np.concatenate(host.columns, axis=1)
    assert columns[2, :5_050].tolist() == sine(5_050).tolist()
    assert np.isfinite(columns[3]).all()
    assert columns[2, -1] == 0.0
    played = [event for event in driven.events() if event["event"] == "played"]
    assert sum(event["samples"] for event in played) >= outcome.ended_at
    driven.device.close()


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["silence", "corrupt", "cut", "unplug"])
def test_a_run_that_loses_the_board_leaves_by_the_one_way_out(board, fault):
    """The reason is kept, blocks under way are recorded as unanswered, the coil is at 0 A."""
    driven = board(faults=[f"{fault}@40"], watchdog={"timeout_s": 3.0, "safe_command": 0.0})
    outcome, host = run_loop(driven, 100_000)
    assert outcome.code == "fault"
    # A command that was never answered may still be executed.
    assert outcome.output == ("unknown" if fault == "unplug" else "set")
    flags = np.concatenate(host.flags)
    assert flags.size == outcome.ended_at
    unanswered = (flags & Flag.SENSOR_INVALID) != 0
    lost = (FIFO_BLOCKS + 1) * BLOCK  # those in the FIFO, and the one being sent
    assert unanswered.sum() == lost
    assert unanswered[-lost:].all()
    driven.pass_s(4.0)
    deadline = time.monotonic() + 5.0
    while driven.events()[-1]["event"] == "played" and time.monotonic() < deadline:
        time.sleep(0.005)
    last = driven.events()[-1]
    assert last["event"] in {"safe", "watchdog"}
    assert last["current_a"] == 0.0


class TestBoards:
    def test_serial(self):
        profile = with_link(load_profile("cobs_board"), usb=False)
        framing = binary_framing("cobs", "crc16_ccitt_false")
        request, reply = 1 + 1 + 2 + 4, 1 + 1 + 1 + 2 + 4 + 2 + 2
        time = exchange_time(profile)
        assert time.request_s == pytest.approx(framing.wire_size(request) * 10 / 115200)
        assert time.reply_s == pytest.approx(framing.wire_size(reply) * 10 / 115200)
        assert time.gaps_s == 0.0

    def test_usb(self):
        slow = load_profile("cobs_board")
        fast = with_link(slow, usb_frame_s=125e-6)
        assert exchange_time(slow).gaps_s == 1e-3
        assert exchange_time(fast).gaps_s == 125e-6
        assert exchange_time(with_link(slow, baud=9600)) == (exchange_time(slow))

    def test_block(self):
        profile = load_profile("cobs_board_fifo")
        one, many = (exchange_time(profile, block) for block in (1, 100))
        assert many.samples == 100
        assert many.highest_rate_hz > 50 * one.highest_rate_hz
        assert many.highest_rate_hz > 50e3
