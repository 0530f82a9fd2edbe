"""The host watchdog of a Modbus device: what feeds it, and what opens a device that has tripped."""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.modbus_dac import ModbusDac

TIMEOUT_S = 0.5
TRIPPED = {"timeout_s": TIMEOUT_S}
SOFT = """\
vendor: nobody
model: a module that obeys while its watchdog is tripped, and acts once it is cleared
source: [this test]
verified: "yes"
link: {kind: tcp}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 0, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  IN: {address: 2, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog:
  unit_s: 0.1
  min_s: 0.1
  max_s: 10.0
  kick: any
  on_trip: ON_TRIP
  refuses_while_tripped: REFUSES
  tripped: {address: 28, type: uint16, mask: 1}
  arm:
    - {kind: write, address: 22, type: uint16, value: timeout}
    - {kind: write, address: 24, type: uint16, value: 1}
  clear:
    - {kind: write, address: 26, type: uint16, value: 1}
SAFE"""
SAFE = """\
  safe:
    OUT:
      - {kind: write, address: 20, type: float32, value: safe}
"""


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


@pytest.fixture
def soft(tmp_path):
    """Return a function that writes a profile of a module and returns its path."""

    def of(*, on_trip="safe", refuses="false", safe=SAFE):
        path = tmp_path / "soft.yaml"
        text = SOFT.replace("ON_TRIP", on_trip).replace("REFUSES", refuses).replace("SAFE", safe)
        path.write_text(text, encoding="utf-8")
        return str(path)

    return of


def trip(made, current_a):
    """Let a device's watchdog trip in the middle of a run."""
    made.open()
    made.exchange(current_a)
    made.time.sleep(TIMEOUT_S + 0.1)
    made.emulated.device.tick(made.time.now_ns)
    assert made.emulated.device.tripped
    made.device.close()


class TestWatchdog:
    """The watchdog belongs to the device that drives."""

    def test_writes_feed_it(self, serve):
        """Samples keep it quiet, though every second request is for the reader; silence trips."""
        served = serve("icp_m7024", "icp_m7017")
        device = served.device(watchdog={"timeout_s": 1.0})
        device.open(5.0, 1)
        device.arm()
        for _ in range(6):
            served.clock.pass_s(0.5)
            exchange(device, 2.0)
        assert not served.emulator.device.tripped
        served.clock.pass_s(1.5)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 2.0)
        assert served.emulator.device.tripped

    @pytest.mark.parametrize("profile", ["wago_750", "beckhoff_bk9000"])
    def test_it_does_not_count_while_a_run_waits_to_start(self, driven, profile):
        """Opening leaves it disarmed, however long the start signal takes."""
        made = driven(profile, watchdog=TRIPPED)
        made.device.open(100.0, 1)
        made.time.sleep(60.0)
        made.device.arm()
        made.exchange(1.0)
        assert not made.emulated.device.tripped
        made.time.sleep(TIMEOUT_S + 0.1)
        with pytest.raises(DeviceError, match="exception 4"):
            made.exchange(1.0)

    def test_a_device_that_cannot_be_armed_is_let_go(self, driven):
        """No exchange may follow."""
        made = driven("wago_750", watchdog=TRIPPED)
        with pytest.raises(DeviceError, match=r"not open \(to arm the watchdog\)"):
            made.device.arm()
        made.device.open(100.0, 1)
        made.link.silent_until_s = 1e9
        with pytest.raises(DeviceError, match=r"no answer .* \(to arm the watchdog\)"):
            made.device.arm()
        assert not made.link.is_open
        with pytest.raises(DeviceError, match="not open"):
            made.exchange(1.0)


class TestTrip:
    """A device that an earlier run has left tripped."""

    @pytest.mark.parametrize(
        "profile", ["wago_750", "beckhoff_bk9000", "soft", "soft refuses", "soft zero"]
    )
    def test_opening_does_not_move_the_output(self, driven, soft, profile):
        """The register still holds the command at which the host died; it must not take effect."""
        words = profile.split()
        if words[0] == "soft":
            refuses = "true" if "refuses" in words else "false"
            zero = {"on_trip": "zero", "safe": ""} if "zero" in words else {}
            profile = soft(refuses=refuses, **zero)
        made = driven(profile, watchdog=TRIPPED)
        trip(made, 3.21)
        before = len(made.writes())
        made.open()
        assert made.device.output() == pytest.approx(0.0, abs=1e-3)
        made.exchange(0.01)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert max(map(abs, since)) == pytest.approx(0.01, abs=1e-3)
        assert not made.emulated.device.tripped

    def test_the_output_stays_where_the_earlier_run_wanted_it(self, driven, soft):
        """The device's own safe value counts, whatever the next experiment says."""
        made = driven(soft(), watchdog={**TRIPPED, "safe_command": 1.0})
        trip(made, 3.0)
        before = len(made.writes())
        device = made.another(watchdog=TRIPPED)
        device.open(100.0, 1)
        assert device.output() == pytest.approx(1.0)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert since == pytest.approx(len(since) * [1.0])

    def test_what_was_held_is_held_on(self, driven, soft):
        """Where a trip leaves the output, so does opening."""
        made = driven(soft(on_trip="hold", safe=""))
        has = made.emulated.device
        made.open()
        made.exchange(2.0)
        has._watchdog.tripped = True
        made.open()
        assert made.device.output() == pytest.approx(2.0)
        assert not has.tripped

    def test_unknown_output_is_refused(self, driven, soft):
        """With no safe value in a register or in the experiment, nobody knows where it is."""
        made = driven(soft(safe=""), watchdog=TRIPPED)
        trip(made, 3.0)
        device = made.another(watchdog="none")
        before = made.writes()
        with pytest.raises(DeviceError, match="where that has put the output is not known"):
            device.open(100.0, 1)
        assert made.writes() == before
        device.make_safe(0.0)
        assert not made.emulated.device.tripped
        assert made.current_a == 0.0

    @pytest.mark.parametrize("refuses", ["true", "false"])
    def test_last_write_comes_before_and_after_the_trip_is_cleared(self, driven, soft, refuses):
        """The stale command never takes effect, whether the device obeys meanwhile or not."""
        made = driven(soft(refuses=refuses), watchdog=TRIPPED)
        trip(made, 3.0)
        before = len(made.writes())
        made.device.make_safe(-1.0)
        since = [each["current_a"] for each in made.writes()[before:]]
        assert since == pytest.approx(len(since) * [-1.0])
        assert made.current_a == pytest.approx(-1.0)
        assert not made.emulated.device.tripped
