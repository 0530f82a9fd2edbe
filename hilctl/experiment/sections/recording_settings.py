"""The ``recording`` section: settings, and the expected size of a recording."""

from typing import Annotated, Literal, Self

import numpy as np

from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.recording.metadata_keys import RECORDINGS
from hilctl.waveforms.build import Reference

_FILE_BYTES = 15e3  # description, model and message schemas
_SAMPLE_BYTES = 6.0  # time, displacement and measured command: what their noise leaves
_NEW_BYTES = 13.0  # a value of reference or command that its chunk does not contain yet
_SCOPE_BYTES = 48.0  # a message of ``/scope``
_TICK_BYTES = 11.0
_CHUNK_SAMPLES = 90_000  # in a full chunk, which is compressed as a whole
_COUNTED_CHUNKS = 4


class RecordingConfig(StrictModel):
    """Recording of a run.

    Attributes:
        folder: Folder of recordings without an explicit name, relative to the working folder.
        flush_s: Longest time until a sample is in the file; until then it is in the ring.
        sync: Whether every flush waits for the disk, so that a power cut loses at most ``flush_s``.
            The end of a run always waits.
        scope_rate_hz: Highest rate of the ``/scope`` topic.
        ring_s: Capacity of the ring between loop and recorder, in seconds of samples.
        on_failure: Reaction when the disk has accepted nothing for half of ``ring_s``: ``stop``
            with the safe ramp, or ``go_on`` and count the lost samples once the ring is full.
            Failed writes are retried.
    """

    folder: str = RECORDINGS
    flush_s: Annotated[float, Field(gt=0.0, le=10.0)] = 2.0
    sync: bool = False
    scope_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 1000.0
    ring_s: Annotated[float, Field(ge=1.0, le=60.0)] = 10.0
    on_failure: Literal["stop", "go_on"] = "stop"

    @model_validator(mode="after")
    def _room(self) -> Self:
        if self.ring_s < 3.0 * self.flush_s:
            raise ValueError(
                f"ring_s must be at least three times flush_s: {self.ring_s:g} and {self.flush_s:g}"
            )
        return self

    def expected_bytes(
        self, reference: Reference, before: int, block: int, *, noisy: bool
    ) -> float:
        """Return the compressed size of a recording; measured sizes are within 30 % of it.

        ``before`` is the number of samples before the waveform; ``noisy`` tells whether input and
        command have the noise of the sensor. Values that repeat within a chunk take almost no
        space, so the share of new ones decides.
        """
        values, rate_hz = reference.values, reference.sample_rate_hz
        samples = values.size + before
        chunk = max(1, min(values.size, _CHUNK_SAMPLES, round(self.flush_s * rate_hz)))
        columns, new = 1 + (reference.unit == "um"), 1.0
        if noisy:
            columns += 1
        else:
            starts = np.linspace(0, values.size - chunk, _COUNTED_CHUNKS).astype(int).tolist()
            counts = [np.unique(values[start : start + chunk]).size for start in starts]
            new = sum(counts) / (len(counts) * chunk)
        scope = min(1.0, self.scope_rate_hz / rate_hz)
        each = _SAMPLE_BYTES + _NEW_BYTES * columns * new + _SCOPE_BYTES * scope
        return _FILE_BYTES + samples * (each + _TICK_BYTES / block)
