"""``python -m hilctl.cli``."""

from hilctl.cli import main

main()
