"""Settings of the adapter tests."""

import os

# Before any message class is imported: Jazzy corrupts fields of a wrong type silently.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

from hypothesis import settings

# A first call imports type support, for half a second: no limit on the time of one example.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
