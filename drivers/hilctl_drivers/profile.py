"""Device profiles: what a commercial device is, loaded from YAML and checked whole.

A profile says everything that a driver must know of a device and nothing of what is wired to it.
Shipped profiles are in ``profiles/``; a user's own is given by its path.
"""

import json
from pathlib import Path
from typing import Any, TypeAlias

import yaml
from pydantic import ValidationError
from pydantic.json_schema import models_json_schema

from hilctl.base.errors import ConfigError, InputError, Problem
from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.profile_problems import read_yaml, rules_broken, value_at
from hilctl_drivers.text.profile import AsciiProfile

Profile: TypeAlias = ModbusProfile | AsciiProfile | FrameProfile
"""A device's profile; which one follows from ``link.kind``."""

FOLDER = Path(__file__).parent / "profiles"
_CLASSES: dict[str, type[ModbusProfile] | type[AsciiProfile] | type[FrameProfile]] = {
    "tcp": ModbusProfile,
    "rtu": ModbusProfile,
    "ascii": AsciiProfile,
    "frames": FrameProfile,
}


def shipped_profiles() -> dict[str, Path]:
    """Return the shipped profiles' files by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.yaml"))}


def load_profile(name_or_path: str) -> Profile:
    """Return a profile by the name of a shipped one, or by path.

    What has a suffix or a slash is a path.

    Raises:
        InputError: There is no such profile, or the file can't be read.
        ConfigError: It breaks rules; all are listed.
    """
    shipped = shipped_profiles()
    if name_or_path in shipped:
        path = shipped[name_or_path]
    elif "/" in name_or_path or Path(name_or_path).suffix in {".yaml", ".yml"}:
        path = Path(name_or_path)
    else:
        raise InputError(
            f"no profile '{name_or_path}' is shipped: take one of {', '.join(shipped)},"
            " or give the path of a .yaml file"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text") from None
    except OSError as error:
        raise InputError(f"{path}: can't be read: {error.strerror}") from None
    return parse_profile(text, str(path))


def parse_profile(text: str, where: str) -> Profile:
    """Return the profile in a YAML text.

    Args:
        text: The YAML.
        where: Its name in messages.

    Raises:
        ConfigError: It breaks rules; all are listed.
    """
    try:
        data = read_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        hint = " ".join(str(error).split())
        raise ConfigError([Problem(where, "", "is not readable YAML", hint=hint)]) from None
    if not isinstance(data, dict):
        raise ConfigError([Problem(where, "", "must hold a mapping of keys to values")])
    kind = value_at(data, ("link", "kind"))
    if not isinstance(kind, str) or kind not in _CLASSES:
        rule = f"must be one of {', '.join(_CLASSES)}"
        raise ConfigError(
            [Problem(where, "link.kind", rule, "nothing" if kind is None else repr(kind))]
        )
    try:
        profile = _CLASSES[kind].model_validate(data)
    except ValidationError as error:
        raise ConfigError(rules_broken(error, data, where, _known_keys(kind))) from None
    missing = [key for key in profile.unverified if value_at(data, key.split(".")) is None]
    if missing:
        rule = "must name keys that are in this file"
        problems = [Problem(where, "unverified", rule, key) for key in missing]
        raise ConfigError(problems)
    return profile


def _known_keys(kind: str) -> set[str]:
    schema = _CLASSES[kind].model_json_schema()
    parts = (schema, *schema["$defs"].values())
    return {name for part in parts for name in part.get("properties", {})}


def with_link(profile: Profile, **changes: Any) -> Profile:
    """Return a profile with other link settings, such as the baud that a device was set to.

    Raises:
        InputError: The link has no such setting, or the value breaks a rule.
    """
    data = profile.model_dump()
    data["link"] |= changes
    try:
        return type(profile).model_validate(data)
    except ValidationError as error:
        problems = rules_broken(error, data, profile.title, _known_keys(profile.link.kind))
        raise InputError("\n".join(str(problem) for problem in problems)) from None


def profile_schema_text() -> str:
    """Return the JSON schema of profiles, as the text of ``profiles/schema.json``."""
    models = (ModbusProfile, AsciiProfile, FrameProfile)
    refs, schema = models_json_schema([(model, "validation") for model in models])
    whole = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "hilctl device profile",
        "oneOf": [refs[model, "validation"] for model in models],
        "$defs": schema["$defs"],
    }
    return json.dumps(whole, indent=1, sort_keys=True) + "\n"
