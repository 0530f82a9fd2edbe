"""Device profiles: what a commercial device is, loaded from YAML and checked whole.

A profile says everything that a driver must know of a device and nothing of what is wired to it.
Shipped profiles are in ``profiles/``; a user's own is given by its path.
"""

import json
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import ValidationError
from pydantic.json_schema import models_json_schema

from hilctl.base.errors import ConfigError, InputError, Problem
from hilctl.base.files import read_text
from hilctl.base.yaml.document import Document
from hilctl.base.yaml.messages import broken_rules, loc_of
from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.modbus.profile import ModbusProfile
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
    return parse_profile(read_text(path), str(path))


def parse_profile(text: str, where: str) -> Profile:
    """Return the profile in a YAML text.

    Args:
        text: The YAML.
        where: Its name in messages.

    Raises:
        ConfigError: It breaks rules; all are listed.
    """
    document = Document(where, text)
    link = document.data.get("link")
    kind = link.get("kind") if isinstance(link, dict) else None
    if not isinstance(kind, str) or kind not in _CLASSES:
        rule = f"must be one of {', '.join(_CLASSES)}"
        value = "nothing" if kind is None else repr(kind)
        place = document.where(("link", "kind"))
        raise ConfigError([Problem(place, "link.kind", rule, value)])
    profile = document.validate(_CLASSES[kind])
    problems = [
        Problem(
            document.where(("unverified", index)),
            "unverified",
            "must name keys that are in this file",
            key,
        )
        for index, key in enumerate(profile.unverified)
        if not document.holds(loc_of(key))
    ]
    if problems:
        raise ConfigError(problems)
    return profile


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
        problems = broken_rules(error, type(profile), lambda _: profile.title)
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
