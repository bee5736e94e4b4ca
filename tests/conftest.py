# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several test modules share."""

import os
import tempfile
from pathlib import Path

import pytest

# Before any test imports rclpy or matplotlib: stay on this machine, log to a temporary folder,
# draw without a screen. Child processes inherit all three.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="sph_ros_log_"))
os.environ.setdefault("MPLBACKEND", "Agg")


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the real recordings and meshes that lies beside the repository, not in it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not on this machine: no folder {folder}")
    return folder


@pytest.fixture(scope="session")
def compiled_tracker():
    """The tracker's kernels, which are compiled the first time: no test with a deadline waits."""
    from sph_ros.tracking.preparation import prepare

    prepare()


@pytest.fixture(scope="session")
def compiled_liquid():
    """The same for the kernels of most scenes."""
    from sph_ros.sim.kernels import ensure_compiled

    ensure_compiled(["relaxation", "incompressible"])
