"""Compared models as model files, ready to run."""

from pathlib import Path

import numpy as np
import scipy

import hilctl
from hilctl.base.errors import InputError
from hilctl.base.files import write_text
from hilctl.comparison.compare import Comparison, Row
from hilctl.models.base import Provenance
from hilctl.models.files import dump_model

_VERSIONS = {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


def check_free(names: tuple[str, ...], folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder in which a file of one of these models stands already.

    Raises:
        InputError: One does, and may not be replaced.
    """
    taken = [str(folder / f"{name}.yaml") for name in names if (folder / f"{name}.yaml").exists()]
    if taken and not overwrite:
        raise InputError(f"{taken[0]}: exists already: give another --save, or --overwrite")


def save_models(
    comparison: Comparison, folder: Path, *, created: str, overwrite: bool
) -> tuple[Path, ...]:
    """Write each model that was found here to ``folder/NAME.yaml``.

    Args:
        comparison: The models; those that came from files are left out.
        folder: Made where it is not there.
        created: Date and time in ISO 8601, UTC, for the provenance.
        overwrite: Whether a file of that name may be replaced.

    Returns:
        The files.

    Raises:
        InputError: One exists already, and nothing is written, or the folder can't be written to.
    """
    rows = [row for row in comparison.rows if row.identify_s is not None]
    check_free(tuple(row.name for row in rows), folder, overwrite=overwrite)
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for row in rows:
            path = folder / f"{row.name}.yaml"
            model = row.model.model_copy(
                update={"provenance": _provenance(comparison, row, created)}
            )
            write_text(path, dump_model(model), overwrite=overwrite)
            paths.append(path)
    except OSError as error:
        raise InputError(f"{folder}: can't be written: {error.strerror}") from None
    return tuple(paths)


def _provenance(comparison: Comparison, row: Row, created: str) -> Provenance:
    known = row.model.provenance
    return Provenance(
        source=comparison.sources,
        method=known.method or f"{row.title}, as compared: least squares",
        grid=known.grid or tuple(loop.label for loop in comparison.loops),
        parameters=known.parameters,
        errors_percent={"peak": row.error.peak_percent, "rms": row.error.rms_percent},
        versions=_VERSIONS,
        created=created,
    )
