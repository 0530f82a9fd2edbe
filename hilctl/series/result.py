"""What came out of many runs, for programs."""

import math
from dataclasses import asdict
from typing import Any

from hilctl.series.collect import RunSeries, SeriesRun
from hilctl.series.headline import headline
from hilctl.series.page import fitted_trends


def series_mapping(series: RunSeries) -> dict[str, Any]:
    """Return plain values for JSON; a number that is not finite becomes None."""
    return {
        "name": series.name,
        "headline": " ".join(headline(series)),
        "varied": [
            {"key": each.key, "name": each.name, "unit": each.unit, "values": list(each.values)}
            for each in series.dimensions
        ],
        "runs": [_run(run) for run in series.runs],
        "failed": [run.number for run in series.failed],
        "not_read": list(series.missing),
        "trends": [trend.to_mapping() for trend in fitted_trends(series)],
        "drift": series.drift.to_mapping() if series.drift else None,
    }


def _run(run: SeriesRun) -> dict[str, Any]:
    figures = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in asdict(run.figures).items()
    }
    return {
        "run": run.number,
        "reference_run": run.is_reference,
        "values": dict(run.values),
        "result": run.result,
        "recording": run.recording,
        "started": run.digest.started if run.digest else None,
        "model_error_percent": run.digest.model_error_percent if run.digest else None,
        **figures,
    }
