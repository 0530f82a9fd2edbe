"""Read and write model files."""

import hashlib
from pathlib import Path

from hilctl.base.files import TextFiles
from hilctl.base.strict import StrictModel, field_validator
from hilctl.base.yaml import Document, dump, load_document
from hilctl.models.base import HysteresisModel


class ModelFile(StrictModel):
    """A model file: one model under the key ``model``."""

    model: HysteresisModel

    @field_validator("model")
    @classmethod
    def _stands_alone(cls, model: HysteresisModel) -> HysteresisModel:
        if not model.STANDALONE:
            raise ValueError(f"kind must be usable in runs; use a staged model: {model.kind!r}")
        return model


def load_model(path: Path, files: TextFiles | None = None) -> HysteresisModel:
    """Read a model file; raise InputError if unreadable, ConfigError with all violated rules."""
    return load_document(path, files).validate(ModelFile).model


def parse_model(name: str, text: str) -> HysteresisModel:
    """Read a model from a YAML text; raise ConfigError as :func:`load_model` does."""
    return Document(name, text).validate(ModelFile).model


def dump_model(model: HysteresisModel) -> str:
    """Return a model as YAML; reading it back gives the same model, bit for bit."""
    return dump({"model": model.to_mapping()})


def model_sha256(model: HysteresisModel | None) -> str:
    """Return the digest of a model's file content; empty without a model."""
    return hashlib.sha256(dump_model(model).encode()).hexdigest() if model else ""
