# SPDX-License-Identifier: Apache-2.0
"""A recording that somebody in the browser starts and stops: the fluid's topics in a bag."""

import time
from datetime import datetime
from pathlib import Path

from msg_adapters.bags import BagError, BagWriter
from sph_ros.nodes.recorder import DIAGNOSTIC_ARRAY, TopicRecorder


class WebRecording:
    """At most one bag at a time, named after the time it was begun.

    Args:
        node: that subscribes.
        fluid: full name of the fluid node.
        folder: where the bags go.
        say: called with a line of text about what was written, or why nothing was.
    """

    def __init__(self, node, fluid, folder, say):
        self._node, self._fluid, self._say = node, fluid, say
        self._folder = Path(folder).expanduser()
        self._bag = self._topics = None

    @property
    def state(self):
        """How far it is, for people; None where there is none."""
        if self._bag is None:
            return None
        return f"{time.monotonic() - self._begin:.0f} s, {sum(self._topics.counts.values())}"

    def toggle(self, solids):
        """Begin, or end and keep.

        Args:
            solids: name of a solid -> whether it follows poses.
        """
        if self._bag is not None:
            self.stop()
            return
        path = self._folder / f"fluid_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        bag = BagWriter(path)
        try:
            bag.__enter__()
        except (BagError, OSError) as error:
            self._say(f"record: {error}", False)
            return
        self._bag, self._path, self._begin = bag, path, time.monotonic()
        self._topics = TopicRecorder(self._node, self._fluid, self._failed)
        self._topics.record(bag)
        self.follow(solids)

    def follow(self, solids):
        """Record these solids, too; see `toggle`."""
        if self._bag is not None:
            self._topics.listen(solids)

    def heard_report(self, data):
        """A /diagnostics message came."""
        if self._bag is not None:
            self._topics.keep("/diagnostics", DIAGNOSTIC_ARRAY, data)

    def stop(self):
        """End it and keep the bag."""
        if self._bag is None:
            return
        bag, self._bag = self._bag, None
        self._topics.close()
        try:
            bag.__exit__(None)
        except (BagError, OSError) as error:
            self._say(f"record: {error}", False)
            return
        count = sum(self._topics.counts.values())
        self._say(f"recorded {count} messages: {self._path.absolute()}", True)

    def _failed(self, error):
        """Writing failed, say for want of space: keep nothing."""
        bag, self._bag = self._bag, None
        self._say(f"record: {self._path}: {error}; nothing was kept", False)
        try:
            bag.__exit__(type(error), error, None)
        except (BagError, OSError):
            pass  # its folder cannot be removed either; said is enough

    def sweep(self):
        """To be called often: hears nothing more after a failure."""
        if self._bag is None and self._topics is not None:
            self._topics.close()
            self._topics = None
