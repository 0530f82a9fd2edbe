"""The public Python interface: all functions of the command line, typed and stable.

    from hilctl import api

    result = api.run("sine.yaml", settings={"waveform.frequency_hz": 50.0})
    recorded = api.read(result.path)
    print(api.summarize(recorded).peak_error_percent)
    frame = recorded.table.to_pandas()

first_experiment.py  init: a first experiment for a device
runs.py         load, check, run
campaigns.py    characterise, campaign, learn: many runs
recordings.py   read, summarize, report_page, report_runs, replay, export, list_runs, figures
models.py       identify, refine, compare
connection.py   connect: an active run
table.py        samples as named columns with units

The names in ``__all__``, their arguments, and the fields of their results are stable: a name is
deprecated for one minor version before it is removed, and new arguments have defaults. Everything
else in hilctl may change. Errors are :class:`hilctl.base.errors.HilctlError`; an ``InputError``
means that nothing has moved and nothing was written. A module is imported when one of its names is
first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hilctl.api.campaigns import campaign, characterise, learn
    from hilctl.api.connection import RunConnection, connect
    from hilctl.api.first_experiment import WrittenExperiment, init
    from hilctl.api.models import compare, identify, refine
    from hilctl.api.recordings import (
        RecordedRun,
        export,
        figures,
        list_runs,
        read,
        replay,
        report_page,
        report_runs,
        summarize,
    )
    from hilctl.api.runs import check, load, run
    from hilctl.api.table import SampleTable

__all__ = [
    "RecordedRun",
    "RunConnection",
    "SampleTable",
    "WrittenExperiment",
    "campaign",
    "characterise",
    "check",
    "compare",
    "connect",
    "export",
    "figures",
    "identify",
    "init",
    "learn",
    "list_runs",
    "load",
    "read",
    "refine",
    "replay",
    "report_page",
    "report_runs",
    "run",
    "summarize",
]

_MODULES = {
    "RecordedRun": "recordings",
    "RunConnection": "connection",
    "SampleTable": "table",
    "WrittenExperiment": "first_experiment",
    "campaign": "campaigns",
    "characterise": "campaigns",
    "check": "runs",
    "compare": "models",
    "connect": "connection",
    "export": "recordings",
    "figures": "recordings",
    "identify": "models",
    "init": "first_experiment",
    "learn": "campaigns",
    "list_runs": "recordings",
    "load": "runs",
    "read": "recordings",
    "refine": "models",
    "replay": "recordings",
    "report_page": "recordings",
    "report_runs": "recordings",
    "run": "runs",
    "summarize": "recordings",
}
"""The module of each name."""

if not TYPE_CHECKING:

    def __getattr__(name):
        """Return a public name; its module is imported when it is first used."""
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
