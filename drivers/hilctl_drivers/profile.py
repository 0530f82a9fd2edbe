"""Profiles of commercial devices: load and validate them from YAML.

A profile describes a device, not its wiring. Shipped profiles are in ``profiles/``; a user's own is
named by its path.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, TypeAlias, TypeVar, cast

from pydantic import PlainSerializer, PlainValidator, ValidationError
from pydantic.json_schema import models_json_schema

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.formatting import did_you_mean
from hilctl.base.strict import KeySchema
from hilctl.base.yaml import Document, broken_rules, loc_of, option_file
from hilctl_drivers.profile_base import BaseProfile

FOLDER = Path(__file__).parent / "profiles"
LINK_KINDS = {
    "ascii": "ascii.ascii_profile:AsciiProfile",
    "ascii_tcp": "ascii.ascii_profile:AsciiProfile",
    "bytes": "ascii.ascii_profile:AsciiProfile",
    "bytes_tcp": "ascii.ascii_profile:AsciiProfile",
    "frames": "board.board_profile:FrameProfile",
    "rtu": "modbus.modbus_profile:ModbusProfile",
    "rtu_tcp": "modbus.modbus_profile:ModbusProfile",
    "sensor_stream": "sensor_stream.stream_profile:StreamProfile",
    "sensor_stream_serial": "sensor_stream.stream_profile:StreamProfile",
    "sensor_stream_udp": "sensor_stream.stream_profile:StreamProfile",
    "tcp": "modbus.modbus_profile:ModbusProfile",
}
"""Class of profiles per ``link.kind``; imported when it is needed."""
_Profile = TypeVar("_Profile", bound=BaseProfile)


@dataclass(frozen=True, slots=True)
class NamedProfile:
    """A profile, its text, and its name in the experiment (a shipped profile, or a path)."""

    name: str
    profile: BaseProfile
    text: str


def profile_class(kind: str) -> type[BaseProfile]:
    """Return the class of profiles with this ``link.kind``."""
    return cast("type[BaseProfile]", resolve_name(f"hilctl_drivers.{LINK_KINDS[kind]}"))


def shipped_profiles() -> dict[str, Path]:
    """Return the shipped profiles' files by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.yaml"))}


def load_profile(name_or_path: str) -> BaseProfile:
    """Return a shipped profile by name, or another one by path (with a slash or a YAML suffix).

    Raises:
        InputError: There is no such profile, or the file cannot be read.
        ConfigError: It breaks rules; all are listed.
    """
    return _load(name_or_path, None, None).profile


def _load(name_or_path: str, files: TextFiles | None, folder: Path | None) -> NamedProfile:
    shipped = shipped_profiles()
    if name_or_path in shipped:
        path = shipped[name_or_path]
    elif "/" in name_or_path or Path(name_or_path).suffix in {".yaml", ".yml"}:
        path = (folder or Path()) / name_or_path
    else:
        hint = did_you_mean(name_or_path, shipped)
        raise InputError(
            f"no profile '{name_or_path}' is shipped ({hint}): take another one, or give the path "
            "of a .yaml file"
        )
    text = (files or TextFiles()).read(path)
    return NamedProfile(name_or_path, parse_profile(text, str(path)), text)


ProfileName: TypeAlias = Annotated[
    NamedProfile,
    PlainValidator(option_file(NamedProfile, _load), json_schema_input_type=str),
    PlainSerializer(lambda named: named.name, return_type=str),
]
"""An option that names a profile; it holds the profile too once it is validated."""


def parse_profile(text: str, where: str) -> BaseProfile:
    """Return the profile in a YAML text named ``where``; raise ConfigError with all problems."""
    document = Document(where, text)
    kind = document.value(("link", "kind"))
    if not isinstance(kind, str) or kind not in LINK_KINDS:
        rule = f"must be one of {', '.join(LINK_KINDS)}"
        value = "nothing" if kind is None else repr(kind)
        raise ConfigError([document.problem("link.kind", rule, value)])
    unknown = document.data.keys() - profile_class(kind).model_fields
    others = [other for other in LINK_KINDS if unknown and _has_keys(document, other)]
    if others:
        rule = f"must be one of {', '.join(others)} with the key {min(unknown)}"
        raise ConfigError([document.problem("link.kind", rule, repr(kind))])
    profile = document.validate(profile_class(kind))
    problems = [
        ConfigProblem(
            document.where(("unverified", index)),
            "unverified",
            "must name keys that are in this file",
            key,
        )
        for index, key in enumerate(profile.unverified)
        if not document.holds(loc_of(key))
    ]
    problems += [document.problem(key, rule, value) for key, rule, value in profile.misfits()]
    if problems:
        raise ConfigError(problems)
    return profile


def _has_keys(document: Document, kind: str) -> bool:
    """Return whether a file has top-level keys of profiles of a kind."""
    fields, keys = profile_class(kind).model_fields, document.data.keys()
    return fields.keys() >= keys >= {name for name, each in fields.items() if each.is_required()}


def with_link(profile: _Profile, **changes: Any) -> _Profile:
    """Return a profile with other link settings by name, except those that are None.

    Raises:
        InputError: The link has no such setting, the value breaks a rule, or the device cannot be
            set to that baud.
    """
    changes = {key: value for key, value in changes.items() if value is not None}
    if not changes:
        return profile
    if "baud" in changes:
        check_baud(profile, changes["baud"])
    data = profile.model_dump()
    data["link"] |= changes
    try:
        return type(profile).model_validate(data)
    except ValidationError as error:
        problems = broken_rules(error, type(profile), lambda _: profile.title)
        raise InputError("\n".join(str(problem) for problem in problems)) from None


def check_baud(profile: BaseProfile, baud: int) -> None:
    """Raise InputError for a baud that is not among those in the profile, if it lists any."""
    others: tuple[int, ...] = getattr(profile.link, "bauds", ())
    known = sorted({*others, getattr(profile.link, "baud", baud)})
    if others and baud not in known:
        text = ", ".join(map(str, known))
        raise InputError(f"baud must be one that {profile.title} can be set to, {text}, got {baud}")


def profile_schema_text() -> str:
    """Return the JSON schema of profiles, as the text of ``profiles/schema.json``."""
    models = list(dict.fromkeys(map(profile_class, LINK_KINDS)))
    refs, schema = models_json_schema(
        [(model, "validation") for model in models], schema_generator=KeySchema
    )
    whole = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "hilctl device profile",
        "oneOf": [refs[model, "validation"] for model in models],
        "$defs": schema["$defs"],
    }
    return json.dumps(whole, indent=1, sort_keys=True) + "\n"
