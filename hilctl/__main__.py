"""``python -m hilctl``."""

from hilctl.cli import main

main()
