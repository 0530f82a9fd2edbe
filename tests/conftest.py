"""Settings and fixtures that all tests share."""

import os

from hypothesis import settings

# A shared machine stalls now and then, and a failure in CI must come back when it is run again.
settings.register_profile("local", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")
