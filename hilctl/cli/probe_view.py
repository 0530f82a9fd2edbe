"""What a device said, in a terminal."""

from hilctl.run.probe import Probed


def print_probed(answered: Probed) -> None:
    """Print what a device says of itself, what it reads and puts out, and what of it is wrong."""
    print(f"{answered.name} answers: {answered.description}")
    note = f": {answered.rate_note}" if answered.rate_note else ""
    print(f"at most {answered.max_rate_hz:.6g} samples a second{note}")
    if answered.safe_note:
        print(f"safe value: {answered.safe_note}")
    if answered.displacement_um is not None:
        print(f"reads {answered.displacement_um:.6g} µm")
    if answered.output is None:
        print("what it puts out is not known")
    else:
        print(f"puts out {answered.output:.6g} {answered.command_unit}")
    for key, value in answered.details.items():
        print(f"  {key}: {value}")
    for fault in answered.faults:
        print(f"wrong: {fault}")
