"""``serial_dac`` through a board's FIFO, against an emulated board with a clock of its own."""

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
from hilctl.loop.plan import LoopPlan
from hilctl_drivers.board.board_dac import exchange_time
from hilctl_drivers.emulator.options import EmulatorOptions, parse_fault
from hilctl_drivers.profile import load_profile, shipped_profiles, with_link
from hilctl_drivers.serial_dac import SerialDac, SerialOptions
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from hilctl_drivers.transport.framing import binary_framing
from tests.fakes import FakeHost, ShiftedClock, emulated, logged, made_safe

pytestmark = pytest.mark.slow  # the board's FIFO runs empty in real time

RATE_HZ = 2_500.0
BLOCK = 100
FIFO_BLOCKS = 5  # 200 ms, which a busy machine may take for itself
TIMEOUT_S = 2.0  # a busy machine answers within it
MS = 1_000_000


class Board:
    """A streaming device that is wired to an emulated board."""

    def __init__(self, emulator, log, clock, **options):
        self.emulator = emulator
        self.clock = clock
        self._log = log
        made = {**emulator.options, "timeout_s": TIMEOUT_S, "fifo_blocks": FIFO_BLOCKS, **options}
        self.device = SerialDac(SerialOptions.model_validate(made))
        self.sent = 0

    def open(self):
        self.device.open(RATE_HZ, BLOCK)
        self.device.arm()
        self.sent = 0

    def exchange(self, command):
        """Send one block; return the displacements that came back with it."""
        displacement_um, measured = np.full(BLOCK, np.nan), np.full(BLOCK, np.nan)
        self.device.exchange(self.sent, command, displacement_um, measured)
        self.sent += BLOCK
        return displacement_um

    def hold(self, command, blocks):
        return [self.exchange(np.full(BLOCK, float(command))) for _ in range(blocks)]

    def events(self):
        return logged(self._log)


@pytest.fixture
def board(tmp_path):
    """Return a function that wires a streaming device to an emulated board."""
    text = shipped_profiles()["cobs_board_fifo"].read_text()
    profile = tmp_path / "board.yaml"
    profile.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    stack = []

    def of(faults=(), noise=False, **options):
        log = tmp_path / f"log{len(stack)}.jsonl"
        made = tuple(parse_fault(fault) for fault in faults)
        clock = ShiftedClock()
        wanted = EmulatorOptions(str(profile), log=log, faults=made, noise=noise)
        served = emulated(wanted, clock)
        stack.append((Board(served.__enter__(), log, clock, **options), served))
        return stack[-1][0]

    yield of
    for made, served in stack:
        made.device._release()
        served.__exit__(None, None, None)


def sine(n):
    return 3.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE_HZ)


def test_says_that_it_streams(board):
    """Its FIFO and the exchanges until an answer are known before it is opened."""
    info = board().device.info
    assert info.buffered
    assert (info.fifo_depth, info.latency_blocks) == (8192, FIFO_BLOCKS)
    assert info.details["fifo_depth"] == "8192 samples"
    assert info.details["fifo_level"] == f"{FIFO_BLOCKS} blocks"


def test_each_displacement_belongs_to_its_command(board):
    """What comes back is what the same actuator does sample by sample, as many blocks later."""
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
    """Blocks go out at once until the FIFO is filled, then one for each that was put out."""
    driven = board()
    driven.open()
    driven.hold(1.0, FIFO_BLOCKS)
    assert driven.emulator.device.fifo.played < BLOCK
    start = time.monotonic()
    driven.hold(1.0, 10)
    assert time.monotonic() - start > 0.9 * 10 * BLOCK / RATE_HZ
    assert driven.device.fifo_level_min > BLOCK  # a busy machine takes some for itself


def test_a_stall_of_this_machine_costs_fifo_and_no_sample(board):
    """After a stall shorter than the FIFO holds, blocks go out in a burst and none is missing."""
    driven = board(fifo_blocks=30)  # 1.2 s, of which a busy machine may take most for itself
    driven.open()
    driven.hold(1.0, 35)
    driven.clock.extra_ns += 200 * MS
    assert all(np.isfinite(each).all() for each in driven.hold(1.0, 15))
    assert driven.emulator.device.fifo.underruns == 0
    driven.device.close()


def test_an_underrun_is_told_with_its_length(board):
    """A stall longer than the FIFO holds ends in an error that says by how many samples."""
    driven = board()
    driven.open()
    driven.hold(1.0, 10)
    driven.clock.extra_ns += 320 * MS
    with pytest.raises(DeviceError, match=r"underrun: .* (\d+) sample") as e:
        driven.hold(1.0, 1)
    told = int(str(e.value).split("put out for ")[1].split()[0])
    assert 200 <= told <= 5000  # and what a busy machine takes for itself
    driven.device.make_safe(0.0)
    assert driven.events()[-1]["event"] == "safe"


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("silence", f"no answer within {TIMEOUT_S + 0.04:g} s"),
        ("corrupt", "crc16_ccitt_false|not a COBS frame|behind the final"),
        ("cut", f"within {TIMEOUT_S + 0.04:g} s"),
        ("duplicate", "bytes"),
        ("wrong_id", "reply 91 to message"),
        ("exception", "refused by the board"),
    ],
)
def test_a_bad_answer_is_an_error_and_the_output_can_still_be_made_safe(board, fault, text):
    """No wrong reading is taken, and what is queued is dropped for the safe value."""
    driven = board(faults=[f"{fault}@15"], fifo_blocks=15)
    driven.open()
    with pytest.raises(DeviceError, match=text):
        driven.hold(2.0, 20)
    made_safe(driven.device, 0.0)
    last = driven.events()[-1]
    assert (last["event"], last["current_a"]) == ("safe", 0.0)
    driven.open()
    driven.hold(0.0, 8)


def test_a_silent_host_is_noticed_by_the_board(board):
    """Its watchdog drops what is queued and goes to the safe value; blocks are refused then."""
    driven = board(watchdog={"timeout_s": 0.2, "safe_command": -1.0})
    driven.open()
    driven.hold(2.0, 10)
    driven.clock.extra_ns += 200 * MS
    with pytest.raises(DeviceError, match="watchdog has tripped"):
        driven.hold(2.0, 1)
    last = driven.events()[-1]
    assert (last["event"], last["current_a"]) == ("watchdog", -1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 10.01, -10.01])
def test_a_block_with_a_bad_value_is_refused_whole(board, bad):
    """Nothing of it is queued, and the run can go on."""
    driven = board()
    driven.open()
    driven.hold(1.0, 2)
    command = np.full(BLOCK, 1.0)
    command[40] = bad
    with pytest.raises(DeviceError, match=r"command\[40\]"):
        driven.exchange(command)
    assert driven.emulator.device.queued == 2 * BLOCK
    driven.hold(1.0, 2)


def test_samples_follow_one_another(board):
    """A jump is refused: the board puts samples out one after the other, whatever their index."""
    driven = board()
    driven.open()
    driven.hold(1.0, 2)
    driven.sent += BLOCK
    with pytest.raises(DeviceError, match=r"200 .* got 300"):
        driven.hold(1.0, 1)


@pytest.mark.parametrize(
    ("rate_hz", "block", "options", "text"),
    [
        (RATE_HZ, 513, {}, "block must be 1 to 512 samples, got 513"),
        (RATE_HZ, 500, {"fifo_blocks": 16}, "must fit into the FIFO, 8192 .*at most 15 with this"),
        (50.0, 10, {}, r"sample rate must be in \[100, .*got 50"),
        (200_000.0, 500, {}, r"sample rate must be in \[100, 100000\] Hz"),
        (RATE_HZ, 500, {"watchdog": {"timeout_s": 0.1}}, "3 exchanges must come within"),
    ],
)
def test_what_the_fifo_can_not_do_is_refused_at_open(board, rate_hz, block, options, text):
    """With what would be possible; nothing was put out."""
    driven = board(**options)
    with pytest.raises(DeviceError, match=text):
        driven.device.open(rate_hz, block)
    assert driven.events() == []


def test_opening_again_starts_at_zero_and_keeps_the_output(board):
    """After close the output holds; the next run counts from 0 and starts where it is."""
    driven = board()
    driven.open()
    held = driven.hold(2.0, 20)[-1]
    driven.device.close()
    driven.open()
    first = driven.hold(2.0, FIFO_BLOCKS + 1)[-1]
    assert first[0] == pytest.approx(held[-1], abs=0.5)


def run_loop(driven, n):
    """Run a sine of n samples through the real loop; return its outcome and what it recorded."""
    host = FakeHost(SystemClock(), BLOCK)
    limits = CommandLimits(low=-5.0, high=5.0, slew_per_s=1e5, safe=0.0, ramp_per_s=1e3)
    driven.open()
    plan = LoopPlan(
        reference=sine(n),
        input_um=sine(n),
        block=BLOCK,
        latency_blocks=driven.device.info.latency_blocks,
        sample_rate_hz=RATE_HZ,
        compensator=Compensator(None, RATE_HZ),
        limits=limits,
        interlocks=InterlockContext(stroke_um=(-100.0, 100.0)),
        late_policy="follow",
        start_policy="follow",
        ramp_policy="follow",
    )
    return Loop(plan, driven.device, host).run(host.clock.now_ns()), host


def test_a_whole_run_loses_nothing(board):
    """Every sample of the waveform and the ramp is recorded with the displacement it caused."""
    driven = board(noise=True, fifo_blocks=30)  # 1.2 s: a busy machine stalls for more than 0.2 s
    outcome, host = run_loop(driven, 5_050)
    assert (outcome.code, outcome.safe, outcome.dropped) == ("completed", True, 0)
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
    driven.clock.extra_ns += 4000 * MS
    deadline = time.monotonic() + 5.0
    while driven.events()[-1]["event"] == "played" and time.monotonic() < deadline:
        time.sleep(0.005)
    last = driven.events()[-1]
    assert last["event"] in {"safe", "watchdog"}
    assert last["current_a"] == 0.0


class TestBoards:
    """Binary frames."""

    def test_serial(self) -> None:
        """On a real serial line each byte counts, COBS overhead and CRC too."""
        profile = with_link(load_profile("cobs_board"), usb=False)
        framing = binary_framing("cobs", "crc16_ccitt_false")
        request, reply = 1 + 1 + 2 + 4, 1 + 1 + 1 + 2 + 4 + 2 + 2
        time = exchange_time(profile)
        assert time.request_s == pytest.approx(framing.wire_size(request) * 10 / 115200)
        assert time.reply_s == pytest.approx(framing.wire_size(reply) * 10 / 115200)
        assert time.gaps_s == 0.0

    def test_usb(self) -> None:
        """Over USB the frame counts, not the baud."""
        slow = load_profile("cobs_board")
        fast = with_link(slow, usb_frame_s=125e-6)
        assert exchange_time(slow).gaps_s == 1e-3
        assert exchange_time(fast).gaps_s == 125e-6
        assert exchange_time(with_link(slow, baud=9600)) == (exchange_time(slow))

    def test_block(self) -> None:
        """A stream of blocks carries more samples in the time of one frame."""
        profile = load_profile("cobs_board_fifo")
        one, many = (exchange_time(profile, block) for block in (1, 100))
        assert many.samples == 100
        assert many.highest_rate_hz > 50 * one.highest_rate_hz
        assert many.highest_rate_hz > 50e3
