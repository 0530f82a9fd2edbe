"""The experiments, campaigns and models that come with hilctl, and copies of them to work on."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.files import read_text, write_text
from hilctl.base.yaml.document import load_document
from hilctl.base.yaml.messages import did_you_mean

_PACKAGE = Path(__file__).parents[1]
_SCHEMA = "schema.json"


@dataclass(frozen=True, slots=True)
class Example:
    """A file that comes with hilctl.

    Attributes:
        name: By which it is asked for: its path in the folder, without the ending.
        description: What it is for, as it says itself.
        path: Where it stands.
    """

    name: str
    description: str
    path: Path

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return {**asdict(self), "path": str(self.path)}


def examples_folder() -> Path:
    """Return where they stand: in the installed package, or in ``configs`` of a checkout."""
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def shipped_examples(folder: Path) -> tuple[Example, ...]:
    """Return the YAML files of a folder of examples, those of the folder itself first."""
    paths = sorted(folder.rglob("*.yaml"), key=lambda path: (len(path.parts), path))
    return tuple(
        Example(
            path.relative_to(folder).with_suffix("").as_posix(),
            _description(load_document(path).data),
            path,
        )
        for path in paths
    )


def _description(data: dict[str, Any]) -> str:
    model = data.get("model")
    kind = model.get("kind") if isinstance(model, dict) else None
    return f"model of kind {kind}" if kind else str(data.get("description", ""))


def copy_example(name: str, into: Path, folder: Path) -> tuple[Path, ...]:
    """Copy an example, and the files that it names, to where they can be changed.

    Args:
        name: The example.
        into: Folder for the copies; made where it is missing.
        folder: Where the examples stand.

    Returns:
        The copies, the example's own first. One that is there already and is the same stays.

    Raises:
        InputError: There is no such example, a copy can't be written, or another file has its name;
            then nothing is written.
    """
    known = {example.name: example.path for example in shipped_examples(folder)}
    if name not in known:
        raise InputError(f"there is no example '{name}' ({did_you_mean(name, list(known))})")
    places = {path: into / path.relative_to(folder) for path in _needed(known[name], folder)}
    texts = {copy: read_text(path) for path, copy in places.items()}
    for copy, text in texts.items():
        if copy.exists() and read_text(copy) != text:
            raise InputError(f"{copy}: is there already and differs: give another folder, --into")
    for copy, text in texts.items():
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{copy.parent}: can't be made: {error.strerror}") from None
        if not copy.exists():
            write_text(copy, text, overwrite=False)
    return tuple(texts)


def _needed(path: Path, folder: Path) -> tuple[Path, ...]:
    """Return an example's file, those that it names, and the schema that its first line names."""
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
