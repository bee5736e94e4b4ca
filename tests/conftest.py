# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several test modules share."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

# Before any test imports rclpy or matplotlib: stay on this machine, log to a temporary folder,
# draw without a screen. Child processes inherit all three.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="sph_ros_log_"))
os.environ.setdefault("MPLBACKEND", "Agg")

# Kernels that tests call themselves are compiled like all others, see `sim.kernels.OPTIMISATION`:
# else the same formula in two of them may round differently. Read when numba is loaded.
os.environ.setdefault("NUMBA_OPT", "1")

# A shell starts background jobs deaf to Ctrl-C, which children inherit; tests press it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: Tests from which on they are the whole suite, which needs all kernels sooner or later.
MANY = 500

COMPILE = """
import os
from sph_ros.sim.kernels import ensure_compiled, everything
os.nice(5)
for name in everything():
    ensure_compiled([name])
"""


def pytest_collection_finish(session):
    """Compile beside the first tests: most of those leave a processor idle for three minutes."""
    jit = os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
    if len(session.items) >= MANY and jit and not session.config.option.collectonly:
        root = str(Path(__file__).resolve().parents[1])
        paths = filter(None, [root, os.environ.get("PYTHONPATH")])
        session.compiler = subprocess.Popen(
            [sys.executable, "-c", COMPILE],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )


def pytest_sessionfinish(session):
    """End what still compiles, its children too."""
    compiler = getattr(session, "compiler", None)
    if compiler is not None and compiler.poll() is None:
        os.killpg(compiler.pid, signal.SIGTERM)
        compiler.wait()


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
