"""Everything that the command line does, from Python: small, typed, and kept.

    from hilctl import api

    result = api.run("sine.yaml", settings={"waveform.frequency_hz": 50.0})
    recorded = api.read(result.path)
    print(api.summarize(recorded).peak_error_percent)
    frame = recorded.table.to_pandas()

starting.py     init: a first experiment for a device
running.py      load, check, run, learn: what moves an actuator
campaigns.py    characterise, campaign: many runs
recordings.py   read, summarize, report_page, report_runs, replay, export, list_runs, figures
models.py       identify, refine, compare
connection.py   connect: a run that is going on
table.py        samples as named columns with units

The names in ``__all__``, their arguments, and the fields of what they return are kept: what goes
away is deprecated for one minor version first, and new arguments have defaults. All else in hilctl
may change. Errors are :class:`hilctl.base.errors.HilctlError`: ``InputError`` where nothing has
moved and nothing was written. Each function imports what it needs when it is called.
"""

from hilctl.api.campaigns import campaign, characterise
from hilctl.api.connection import RunConnection, connect
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
from hilctl.api.running import check, learn, load, run
from hilctl.api.starting import WrittenExperiment, init
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
