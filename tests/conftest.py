"""Environment of every test; read before NumPy or a ROS message is imported."""

from __future__ import annotations

import os
import shutil
import tempfile

import pytest

# One thread per test process: the matrices are small, and the sum order must not change.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_threads] = "1"

os.environ["MPLBACKEND"] = "Agg"

# Jazzy does not check the fields of a message unless told to, and corrupts wrong ones silently.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
# Tests neither hear nor disturb other machines, other test runs, or the user's own nodes.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_LOG_DIR"] = _log_dir = tempfile.mkdtemp(prefix="dscp-test-ros-log-")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes the log folder."""
    shutil.rmtree(_log_dir)
