"""What a run says of itself to those who look on: rates, units, limits, and every setting.

It stands in the run's folder from before the start to its end. Whoever reads it needs neither the
experiment nor the device, and nothing that brings numba along.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from hilctl.base.errors import RunError
from hilctl.base.segments import Segment
from hilctl.base.strict import Strict

if TYPE_CHECKING:
    from hilctl.experiment.check import Checked


class SettingRow(Strict):
    """One key of the experiment as it runs.

    Attributes:
        key: Dotted.
        value: As text.
        settable: Whether ``--set`` can give another one; else it is changed in the file.
    """

    key: str
    value: str
    settable: bool


class LimitBounds(Strict):
    """What limiter and interlocks hold the run to; None where there is none.

    Attributes:
        command: Lowest and highest command, in its unit.
        slew_per_s: Fastest change of the command.
        stroke_um: Lowest and highest displacement.
        rms_current_a: Largest running rms of the coil current.
        thermal_time_constant_s: Its time constant.
        heat_a2: Heat of the coil before the run, in A^2.
        tracking_error_um: Largest distance of displacement and reference.
        measured_deviation: Largest distance of command and measured command.
        late_s: A tick later than this ends the run.
    """

    command: list[float]
    slew_per_s: float
    stroke_um: list[float]
    rms_current_a: float | None
    thermal_time_constant_s: float | None
    heat_a2: float
    tracking_error_um: float | None
    measured_deviation: float | None
    late_s: float


class RunDescription(Strict):
    """One run.

    Attributes:
        name: Of the experiment.
        text: The experiment's description.
        device: What its device is.
        simulated: Whether that is a simulation.
        sample_rate_hz: Samples a second.
        block: Samples in a tick.
        command_unit: ``A`` or ``V``.
        measures_command: Whether the device measures its command.
        waveform_unit: Unit of the reference.
        compensator: Kind of its model; empty without one.
        samples: Samples of the waveform.
        segments: Its stretches as :meth:`hilctl.base.segments.Segment.to_mapping`, counted from
            the waveform's first sample.
        limits: What it is held to.
        settings: Every key of its experiment.
    """

    name: str
    text: str
    device: str
    simulated: bool
    sample_rate_hz: float
    block: int
    command_unit: str
    measures_command: bool
    waveform_unit: str
    compensator: str
    samples: int
    segments: list[dict[str, Any]]
    limits: LimitBounds
    settings: list[SettingRow]

    @classmethod
    def of(cls, checked: "Checked") -> Self:
        """Return what a checked experiment says of itself."""
        loaded, reference = checked.loaded, checked.reference
        config, info = loaded.config, loaded.device.info
        return cls(
            name=config.name,
            text=config.description,
            device=info.description,
            simulated=info.simulated,
            sample_rate_hz=config.sample_rate_hz,
            block=config.block,
            command_unit=info.command_unit,
            measures_command=info.measures_command,
            waveform_unit=reference.unit,
            compensator=str(getattr(loaded.model, "kind", "")),
            samples=int(reference.values.size),
            segments=[each.to_mapping() for each in reference.segments],
            limits=_limits(checked),
            settings=setting_rows(loaded.document.data),
        )

    def segments_at(self, waveform_at: int) -> list[Segment]:
        """Return the stretches, counted from the run's first sample.

        Args:
            waveform_at: Index of the waveform's first sample.
        """
        return [Segment.from_mapping(each).shifted(waveform_at) for each in self.segments]

    def write(self, path: Path) -> None:
        """Leave it for those who look on.

        Raises:
            RunError: There is no room for it.
        """
        try:
            path.write_text(self.model_dump_json(), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: no memory: {error.strerror}") from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return what a run has left.

        Raises:
            OSError: There is none.
            ValueError: It is damaged, or another version's.
        """
        return cls.model_validate_json(path.read_bytes())


def _limits(checked: "Checked") -> LimitBounds:
    config = checked.loaded.config
    limits = config.limits
    return LimitBounds(
        command=list(limits.command_range),
        slew_per_s=limits.slew_per_s,
        stroke_um=list(limits.stroke_um),
        rms_current_a=limits.rms_current_a,
        thermal_time_constant_s=limits.thermal_time_constant_s,
        heat_a2=checked.heat_a2,
        tracking_error_um=limits.tracking_error_um,
        measured_deviation=limits.measured_deviation,
        late_s=config.timing.max_late_s,
    )


def setting_rows(value: Any, key: str = "") -> list[SettingRow]:
    """Return the keys of an experiment's data, in order; a sequence is one value of its own."""
    if isinstance(value, dict):
        inner = (setting_rows(each, f"{key}.{name}".strip(".")) for name, each in value.items())
        return [row for rows in inner for row in rows]
    parts = any(isinstance(each, dict | tuple) for each in value) if _is_sequence(value) else False
    text = f"{len(value)} entries" if parts else str(list(value) if _is_sequence(value) else value)
    return [SettingRow(key=key, value=text, settable=not parts)]


def _is_sequence(value: Any) -> bool:
    return isinstance(value, tuple | list)
