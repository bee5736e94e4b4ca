# SPDX-License-Identifier: Apache-2.0
"""What the tracker uses of tf2_ros, which cannot be installed from PyPI."""

import types


class TransformBroadcaster:
    """Keeps what is sent."""

    sent = []

    def __init__(self, _node):
        type(self).sent.clear()

    def sendTransform(self, transforms):  # noqa: N802
        self.sent.extend(transforms)

    @classmethod
    def module(cls):
        return types.SimpleNamespace(TransformBroadcaster=cls)
