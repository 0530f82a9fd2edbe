"""Read and write model files."""

import hashlib
from pathlib import Path
from typing import Annotated, TypeAlias

from hilctl.base.files import TextFiles
from hilctl.base.strict import Field, StrictModel
from hilctl.base.yaml import Document, dump, load_document
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import Refinable, RefinedModel

AnyModel: TypeAlias = Annotated[Refinable | RefinedModel, Field(discriminator="kind")]


class ModelFile(StrictModel):
    """A model file: one model under the key ``model``."""

    model: AnyModel


def load_model(path: Path, files: TextFiles | None = None) -> HysteresisModel:
    """Read a model file; raise InputError if it is not readable, ConfigError with broken rules."""
    return load_document(path, files).validate(ModelFile).model


def parse_model(name: str, text: str) -> HysteresisModel:
    """Read a model from a YAML text; raise ConfigError as :func:`load_model` does."""
    return Document(name, text).validate(ModelFile).model


def dump_model(model: HysteresisModel) -> str:
    """Return a model as YAML; reading it back gives the same model, bit for bit."""
    mapping = {"model": {"kind": getattr(model, "kind"), **model.to_mapping()}}  # noqa: B009
    return dump(mapping)


def model_sha256(model: HysteresisModel | None) -> str:
    """Return the digest of a model as its file would be; empty without a model."""
    return hashlib.sha256(dump_model(model).encode()).hexdigest() if model else ""
