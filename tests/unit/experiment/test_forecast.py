"""What a run will ask of its device is worked out before it starts, and nothing is touched."""

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import ConfigError
from hilctl.base.types import F64
from hilctl.base.yaml import Document
from hilctl.experiment.load import LoadedExperiment, resolve
from hilctl.experiment.preflight import CheckedExperiment, check
from hilctl.models.base import HysteresisModel
from hilctl.models.staged import FieldLag, StagedModel
from tests.published import terfenol_rdpi

CURRENT = """\
name: current
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: {kind: sine, unit: A, amplitude: 6.0, offset: 0.5, frequency_hz: 10.0, duration_s: 1.0}
compensator: none
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
"""
DISPLACEMENT = """\
name: displacement
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform:
  kind: sine
  unit: um
  amplitude: 10.0
  frequency_hz: 10.0
  duration_s: 1.0
  soft_start_s: 0.1
compensator: {model: model.yaml}
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
"""
MODEL = Path(__file__).parents[3] / "configs" / "models" / "terfenol_rdpi.yaml"
INFO = DeviceInfo(
    name="fake",
    description="a device that does nothing",
    command_unit="A",
    command_min=-8.0,
    command_max=8.0,
    sensor_min_um=-100.0,
    sensor_max_um=100.0,
    max_rate_hz=20e3,
)


class DescribedDevice:
    """A device that only says what it is."""

    Options: ClassVar[type[DeviceOptions]] = DeviceOptions

    def __init__(self, info: DeviceInfo) -> None:
        self.info = info

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Refuse: nothing may be opened before the run."""
        raise AssertionError("opened")

    def output(self) -> float:
        """Refuse: nothing may be opened before the run."""
        raise AssertionError("opened")

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Refuse: nothing may move before the run."""
        raise AssertionError("moved")

    def make_safe(self, command: float) -> None:
        """Refuse: nothing may move before the run."""
        raise AssertionError("moved")

    def close(self) -> None:
        """Do nothing."""


def loaded(
    text: str,
    *settings: str,
    model: HysteresisModel | None = None,
    **info: Any,
) -> LoadedExperiment:
    """Read an experiment and put a fake device and a model in."""
    without_model = text.replace("{model: model.yaml}", "none").replace("unit: um", "unit: A")
    made = resolve(Document("x.yaml", text if model is None else without_model), Path(), settings)
    device = DescribedDevice(replace(INFO, **info))
    if model is None:
        return replace(made, device=device)
    waveform = made.config.waveform.model_copy(update={"unit": "um"})
    config = made.config.model_copy(update={"waveform": waveform})
    return replace(made, config=config, device=device, model=model)


def checked(text: str, *settings: str, **given: Any) -> CheckedExperiment:
    return check(loaded(text, *settings, **given))


class TestForecast:
    """What a run will do, in numbers."""

    def test_without_a_compensator(self) -> None:
        """The command is the waveform; its slew counts the step from the safe value."""
        result = checked(CURRENT, "safe.value=-0.5")
        values = 0.5 + 6.0 * np.sin(2.0 * np.pi * 10.0 * np.arange(10_000) / 10e3)
        forecast = result.forecast
        np.testing.assert_allclose(result.reference.values, values, rtol=0.0, atol=1e-11)
        assert forecast.samples == 10_000
        assert forecast.duration_s == pytest.approx(1.0)
        assert forecast.command_unit == "A"
        assert forecast.command_min == forecast.reference_min == pytest.approx(-5.5, abs=1e-4)
        assert forecast.command_max == forecast.reference_max == pytest.approx(6.5, abs=1e-4)
        assert forecast.slew_per_s == pytest.approx(1.0 * 10e3)  # from -0.5 to 0.5 in one sample
        assert forecast.recording_mb == pytest.approx(10_000 * 45.0 / 1e6)

    def test_slew_of_the_waveform_itself(self) -> None:
        """Where the start is soft, the slew is the steepest part of the waveform."""
        forecast = checked(CURRENT, "waveform.soft_start_s=0.1").forecast
        assert forecast.slew_per_s == pytest.approx(2.0 * np.pi * 10.0 * 6.0, rel=1e-3)

    def test_with_a_compensator(self) -> None:
        """The command is that of the inverse, run through in one piece."""
        model = terfenol_rdpi()
        result = checked(DISPLACEMENT, model=model)
        command = model.inverse(10e3).process(result.reference.values)
        assert result.forecast.command_min == command.min()
        assert result.forecast.command_max == command.max()
        steps = np.abs(np.diff(command, prepend=0.0))
        assert result.forecast.slew_per_s == steps.max() * 10e3
        assert (result.forecast.reference_min, result.forecast.reference_max) == (
            result.reference.values.min(),
            result.reference.values.max(),
        )

    def test_safe_value_counts(self) -> None:
        """The output starts at the safe value, so the range holds it."""
        settings = ("waveform.amplitude=1.0", "safe.value=-2.0", "limits.slew_a_per_s=25000.0")
        forecast = checked(CURRENT, *settings).forecast
        assert forecast.command_min == -2.0
        assert forecast.command_max == pytest.approx(1.5, abs=1e-4)

    @pytest.mark.parametrize("chunk", [1, 7, 1000, 9999, 10_000, 10_001])
    def test_chunks_change_nothing(self, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
        """However the reference is cut, the forecast is the same, bit for bit."""
        model = terfenol_rdpi()
        whole = checked(DISPLACEMENT, model=model).forecast
        monkeypatch.setattr("hilctl.experiment.command_simulation.CHUNK", chunk)
        assert checked(DISPLACEMENT, model=model).forecast == whole

    def test_longer_than_a_chunk(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A run of more than a million samples is forecast as if in one piece."""
        settings = ("waveform.duration_s=120.0", "waveform.frequency_hz=0.37")
        forecast = checked(DISPLACEMENT, *settings, model=terfenol_rdpi()).forecast
        assert forecast.samples == 1_200_000
        monkeypatch.setattr("hilctl.experiment.command_simulation.CHUNK", 2_000_000)
        assert checked(DISPLACEMENT, *settings, model=terfenol_rdpi()).forecast == forecast

    def test_what_is_fed_ahead_is_what_is_forecast(self) -> None:
        """A compensator that looks ahead is fed the reference shifted, and held at its end."""
        model = StagedModel.around(terfenol_rdpi(), lag=FieldLag(tau_s=2e-4), delay_s=3e-4)
        result = checked(DISPLACEMENT, model=model)
        values = result.reference.values
        assert result.records_input
        assert result.begun.input_um.tolist() == [*values[4:].tolist(), *[values[-1]] * 4]
        inverse = model.inverse(10e3)
        inverse.process(values[:4].copy())
        command = inverse.process(result.begun.input_um.copy())
        assert result.forecast.command_max == command.max()
        plain = checked(DISPLACEMENT, model=terfenol_rdpi())
        assert not plain.records_input
        assert plain.begun.state is None
        assert plain.begun.input_um is plain.reference.values
        assert result.forecast.recording_mb > plain.forecast.recording_mb

    def test_run_before_that_can_t_be_read_is_refused(self) -> None:
        """A recording that is not there is named with its key."""
        text = DISPLACEMENT.replace("{model: model.yaml}", "{model: m, initial_state: gone.mcap}")
        made = resolve(Document("x.yaml", text.replace("model: m,", f"model: {MODEL},")), Path())
        with pytest.raises(ConfigError, match=r"initial_state: gone\.mcap: no such"):
            check(replace(made, device=DescribedDevice(INFO)))

    def test_to_mapping(self) -> None:
        """A forecast can be printed as JSON."""
        forecast = checked(CURRENT).forecast
        mapping = forecast.to_mapping()
        assert mapping["samples"] == 10_000
        assert mapping["command_unit"] == "A"
        assert mapping["slew_per_s"] == forecast.slew_per_s

    def test_nothing_is_touched(self) -> None:
        """The device is neither opened nor driven, and the experiment comes out as it went in."""
        given = loaded(CURRENT)
        assert check(given).loaded is given
