"""The public Python interface: all functions of the command line, typed and stable.

    from hilctl import api

    result = api.run("sine.yaml", settings={"waveform.frequency_hz": 50.0})
    recorded = api.read(result.path)
    print(api.summarize(recorded).peak_error_percent)
    frame = recorded.table.to_pandas()

The names in ``__all__``, their arguments, and the fields of their results are stable: a name is
deprecated for one minor version before it is removed, and new arguments have defaults. Everything
else in hilctl may change. Each error is a ``HilctlError``; an ``InputError`` means that nothing has
moved, and that no file was written.
"""

from importlib import import_module
from inspect import isfunction
from typing import TYPE_CHECKING

from hilctl.api.words import in_own_words
from hilctl.base.errors import (
    ConfigError,
    DataError,
    DeviceError,
    HilctlError,
    InputError,
    ModelError,
    RunError,
)

if TYPE_CHECKING:
    from hilctl.api.campaigns import (
        calibrate_amplifier,
        calibrate_sensor,
        campaign,
        characterise,
        couple,
        learn,
    )
    from hilctl.api.connection import RunConnection, connect
    from hilctl.api.models import LoadedModel, compare, export_model, identify, load_model, refine
    from hilctl.api.recordings import RecordedRun, export, list_runs, read, replay, summarize
    from hilctl.api.reports import contour, figures, report_page, report_runs
    from hilctl.api.responses import frf, spectrum, step, tune
    from hilctl.api.runs import WrittenExperiment, check, check_axes, init, load, run
    from hilctl.api.studies import StepFaultError, StepStoppedError, StudyRun, StudyStep, study
    from hilctl.api.tables import RunTable, SampleTable

__all__ = [
    "ConfigError", "DataError", "DeviceError", "HilctlError", "InputError", "LoadedModel",
    "ModelError", "RecordedRun", "RunConnection", "RunError", "RunTable", "SampleTable",
    "StepFaultError", "StepStoppedError", "StudyRun", "StudyStep", "WrittenExperiment",
    "calibrate_amplifier", "calibrate_sensor", "campaign", "characterise", "check", "check_axes",
    "compare", "connect", "contour", "couple", "export", "export_model", "figures", "frf",
    "identify", "init", "learn", "list_runs", "load", "load_model", "read", "refine", "replay",
    "report_page", "report_runs", "run", "spectrum", "step", "study", "summarize", "tune",
]  # fmt: skip


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return __all__


if not TYPE_CHECKING:
    _OTHERS = {
        "campaigns": {
            "calibrate_amplifier", "calibrate_sensor", "campaign", "characterise", "couple",
            "learn",
        },
        "connection": {"RunConnection", "connect"},
        "models": {"LoadedModel", "compare", "export_model", "identify", "load_model", "refine"},
        "reports": {"contour", "figures", "report_page", "report_runs"},
        "responses": {"frf", "spectrum", "step", "tune"},
        "runs": {"WrittenExperiment", "check", "check_axes", "init", "load", "run"},
        "studies": {"StepFaultError", "StepStoppedError", "StudyRun", "StudyStep", "study"},
        "tables": {"RunTable", "SampleTable"},
    }  # fmt: skip

    def __getattr__(name):
        """Return a public name; its module is imported when it is first used."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module = next((each for each, names in _OTHERS.items() if name in names), "recordings")
        found = getattr(import_module(f"{__name__}.{module}"), name)
        if isfunction(found):
            found = globals()[name] = in_own_words(found)
        return found
