"""Profile templates read backwards: what a device must understand, and how it answers."""

import re
from string import Formatter

_NUMBER = r"[-+]?[0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?"


class Template:
    """A template as the device that hears it.

    Args:
        text: The template.
        address: The device's address.
    """

    def __init__(self, text: str, address: int) -> None:
        self._bases: dict[str, int] = {}
        parts = []
        for literal, field, spec, _ in Formatter().parse(text):
            parts.append(re.escape(literal))
            if field == "address":
                parts.append(re.escape(format(address, spec or "")))
            elif field is not None:
                hexadecimal = (spec or "").endswith(("X", "x"))
                self._bases[field] = 16 if hexadecimal else 10
                group = r"[0-9A-Fa-f]+" if hexadecimal else _NUMBER
                parts.append(f"(?P<{field}>{group})")
        self._pattern = re.compile("".join(parts), re.ASCII)

    def heard(self, text: str) -> dict[str, float] | None:
        """Return the fields of a line, or None where it is another one."""
        found = self._pattern.fullmatch(text)
        if found is None:
            return None
        return {
            name: float(int(value, 16)) if self._bases[name] == 16 else float(value)
            for name, value in found.groupdict().items()
        }


def in_style(example: str, pattern: str, value: float) -> str:
    """Return a reply like ``example``, with ``value`` where the pattern's group is."""
    found = re.fullmatch(pattern, example, re.ASCII)
    assert found is not None, "a profile's examples match their patterns"
    start, stop = found.span(1)
    model = example[start:stop]
    sign = "+" if model[0] in "+-" else ""
    if "E" in model.upper():
        number = f"{value:{sign}.6E}"
    else:
        decimals = len(model.partition(".")[2])
        value = round(value, decimals) + 0.0  # no device says -0.000
        number = f"{value:{sign}0{len(model)}.{decimals}f}"
    return example[:start] + number + example[stop:]
