"""Shipped examples and copies of them: experiments, campaigns, models, layouts, profiles."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.files import make_folder, read_text, write_text
from hilctl.base.formatting import did_you_mean
from hilctl.base.yaml import load_document
from hilctl.experiment.devices import shipped_profiles

_PACKAGE = Path(__file__).parents[1]
_SCHEMA = "schema.json"
_PROFILES = "profiles"
_LAYOUTS = {".json": "Foxglove and Lichtblick", ".xml": "PlotJuggler"}


@dataclass(frozen=True, slots=True)
class Example:
    """A shipped file."""

    name: str  # path of its copy without suffix
    description: str
    path: Path

    @property
    def copy(self) -> Path:
        """Path of its copy in the folder of copies."""
        return Path(self.name + self.path.suffix)


def examples_folder() -> Path:
    """Return the folder of examples: in the installed package, or ``configs`` of a checkout."""
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def shipped_examples(folder: Path) -> tuple[Example, ...]:
    """Return the examples in a folder, subfolders last, and the shipped profiles."""
    paths = sorted(folder.rglob("*.yaml"), key=lambda path: (len(path.parts), path))
    found = {path.relative_to(folder): _description(load_document(path).data) for path in paths}
    found |= {
        path.relative_to(folder): f"layout for {programs}"
        for ending, programs in _LAYOUTS.items()
        for path in sorted((folder / "layouts").glob(f"*{ending}"))
    }
    found |= {
        path.relative_to(folder): "systemd service of a run" for path in folder.glob("*.service")
    }
    examples = [
        Example(place.with_suffix("").as_posix(), description, folder / place)
        for place, description in found.items()
    ]
    for name, file in shipped_profiles().items():
        profile = load_document(Path(file)).data
        title = f"profile of {profile['vendor']} {profile['model']}"
        examples.append(Example(f"{_PROFILES}/{name}", title, Path(file)))
    return tuple(examples)


def _description(data: dict[str, Any]) -> str:
    model = data.get("model")
    kind = model.get("kind") if isinstance(model, dict) else None
    return f"model of kind {kind}" if kind else str(data.get("description", ""))


def copy_example(name: str, into: Path, folder: Path) -> tuple[Path, ...]:
    """Copy an example and the files that it names from one folder into another, created if missing.

    Returns:
        The copies, that of the example first. Identical existing files are kept.

    Raises:
        InputError: The example is unknown, a copy cannot be written, or a different file exists;
            then nothing is written.
    """
    known = {example.name: example for example in shipped_examples(folder)}
    if name not in known:
        raise InputError(f"there is no example '{name}' ({did_you_mean(name, list(known))})")
    places = {known[name].path: into / known[name].copy}
    if name.startswith(f"{_PROFILES}/"):
        schema = known[name].path.with_name(_SCHEMA)
        places[schema] = into / _PROFILES / _SCHEMA
    elif known[name].path.suffix == ".yaml":
        needed = _needed(known[name].path, folder)
        places |= {path: into / path.relative_to(folder) for path in needed}
    texts = {copy: read_text(path) for path, copy in places.items()}
    for copy, text in texts.items():
        if copy.exists() and read_text(copy) != text:
            raise InputError(f"{copy}: exists already and differs: use another folder, --into")
    for copy, text in texts.items():
        make_folder(copy.parent)
        if not copy.exists():
            write_text(copy, text, overwrite=False)
    return tuple(texts)


def schema_file() -> Path:
    """Return the JSON schema of experiments."""
    return examples_folder() / _SCHEMA


def copy_schema(into: Path) -> Path:
    """Copy the JSON schema of experiments into a folder that has none."""
    copy = into / _SCHEMA
    if not copy.exists():
        write_text(copy, read_text(schema_file()), overwrite=False)
    return copy


def _needed(path: Path, folder: Path) -> tuple[Path, ...]:
    """Return the file of an example, the files it names, and the schema."""
    found = {path: None}
    for named in _texts(load_document(path).data):
        other = path.parent / named
        if named.endswith(".yaml") and other.is_file():
            found.update(dict.fromkeys(_needed(other.resolve(), folder)))
    schema = folder / _SCHEMA
    return (*found, schema) if schema.is_file() else tuple(found)


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)
    elif isinstance(value, str):
        yield value
