# SPDX-License-Identifier: Apache-2.0
"""The liquid's surface in a thread of its own, beside the stepping. The newest state wins."""

import threading
import time


class SurfaceWorker:
    """Works on one job at a time; a job that waits is replaced by a newer one.

    Attributes:
        milliseconds: the last surface took.
        triangles: of the last surface.

    Args:
        publish: called in the thread with a job; returns the number of triangles.
        report: called with a line of text when that fails.
    """

    def __init__(self, publish, report):
        self._publish, self._report = publish, report
        self.milliseconds, self.triangles = 0.0, 0
        self._job, self._stopping = None, False
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="surface", daemon=True)

    def start(self):
        """Begin to wait for jobs."""
        self._thread.start()

    def stop(self):
        """End after the present job."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join()

    def submit(self, job):
        """Have a surface published as soon as the one before is done."""
        with self._wake:
            self._job = job
            self._wake.notify()

    def work(self, job):
        """Publish a surface in the calling thread."""
        begin = time.perf_counter()
        try:
            self.triangles = self._publish(job)
        except Exception as error:  # a surface less must not end the node
            self._report(f"no surface: {type(error).__name__}: {error}")
        self.milliseconds = (time.perf_counter() - begin) * 1e3

    def _run(self):
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._stopping or self._job is not None)
                if self._stopping:
                    return
                job, self._job = self._job, None
            self.work(job)
