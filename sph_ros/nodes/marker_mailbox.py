# SPDX-License-Identifier: Apache-2.0
"""A mailbox for one thing: who comes later replaces what nobody fetched."""

import threading


class Mailbox:
    """Between threads.

    Attributes:
        dropped: number of things that were replaced before anybody fetched them.
    """

    def __init__(self):
        self.dropped = 0
        self._thing = None
        self._condition = threading.Condition()

    def put(self, thing):
        """Leave a thing that is not None; it replaces an older one."""
        with self._condition:
            self.dropped += self._thing is not None
            self._thing = thing
            self._condition.notify()

    def get(self, timeout):
        """Fetch the thing; None when none comes within so many seconds."""
        with self._condition:
            if self._thing is None:
                self._condition.wait(timeout)
            thing, self._thing = self._thing, None
            return thing
