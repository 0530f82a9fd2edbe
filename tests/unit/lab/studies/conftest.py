"""A rig that runs the steps of a study."""

import time
from dataclasses import replace
from types import SimpleNamespace

from hilctl.experiment.state_files import MachineTime
from hilctl.run.start import unpaced

RECORDED = {}
"""Result and recording of each experiment with its settings and heat."""


class StudyRig:
    """A simulated rig that records runs and pauses, with an optional failure of one run."""

    rate_hz = 5000.0

    def __init__(self, ends_at=99, error=None, **ends):
        self.ends_at, self.error, self.ends = ends_at, error, ends
        self.runs, self.rows, self.texts, self.pauses = [], [], [], []
        self.time_s = time.time()
        self.observers = {
            "run": self,
            "now": self.now,
            "sleep_s": self.sleep,
            "on_progress": lambda done, text: self.texts.append((done, text)),
        }

    def __call__(self, path, settings, output, on_part, *, overwrite, heat_a2):
        assert overwrite or not output.exists()
        self.runs.append(SimpleNamespace(name=output.name, settings=settings, heat_a2=heat_a2))
        on_part(0.5)
        fails = len(self.runs) == self.ends_at
        if fails and self.error:
            raise self.error
        asked = path.read_text(encoding="utf-8"), tuple(settings), heat_a2
        if asked not in RECORDED:
            result = unpaced(path, settings, output, overwrite=overwrite, heat_a2=heat_a2)
            RECORDED[asked] = result, output.read_bytes()
        result, recording = RECORDED[asked]
        output.write_bytes(recording)
        self.time_s += result.samples / self.rate_hz
        return replace(result, path=output, **(self.ends if fails else {}))

    def now(self):
        return MachineTime(self.time_s, self.time_s)

    def sleep(self, seconds):
        self.pauses.append(seconds)
        self.time_s += seconds

    @property
    def names(self):
        return [run.name for run in self.runs]
