# SPDX-License-Identifier: Apache-2.0
"""Child processes that live and die together."""

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: How long a child may take to end after SIGINT [s].
GRACE = 1.2

#: Lines of a child's output that are shown when it fails.
LAST_LINES = 8


class ChildError(RuntimeError):
    """A child ended by itself and should not have; says which, and its last words."""


class Children:
    """Starts programs of this package; a context manager that ends them all.

    They stay in our process group, so whatever signal a terminal sends reaches them too. Their
    output goes to files: a pipe that nobody reads would stop them.
    """

    def __enter__(self):
        self._folder = tempfile.TemporaryDirectory(prefix="sph_ros_")
        self._processes = {}
        return self

    def __exit__(self, *_):
        self.stop()
        self._folder.cleanup()

    def start(self, name, module, *arguments):
        """Run `python -m module arguments...`."""
        with open(self._log(name), "wb") as log:
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def check(self):
        """Raise ChildError if a child has ended; one that ended well is forgotten."""
        for name, process in list(self._processes.items()):
            status = process.poll()
            if status is None:
                continue
            del self._processes[name]
            if status != 0:
                last = "\n".join(self.output(name).strip().splitlines()[-LAST_LINES:])
                raise ChildError(f"{name} ended with status {status}:\n{last}")

    def output(self, name):
        """Everything a child has printed so far."""
        with contextlib.suppress(OSError):
            return self._log(name).read_text(encoding="utf-8", errors="replace")
        return ""

    def stop(self):
        """SIGINT to all, and SIGKILL to those that do not heed it in time."""
        for process in self._processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + GRACE
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes = {}

    def _log(self, name):
        return Path(self._folder.name) / f"{name}.log"
