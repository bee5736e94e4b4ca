# SPDX-License-Identifier: Apache-2.0
"""Says that poses sent to a solid which does not follow any move nothing."""

from diagnostic_msgs.msg import DiagnosticStatus

from sph_ros.nodes.diagnostics import solid_status

#: Why a solid does not follow poses, by its control.
WHY = {
    "free": "it is free: the liquid, gravity and touches move it",
    "fixed": "it is fixed",
    "path": "it follows the path in the scene",
}

#: Pause between two warnings of the same kind [s].
WARNING_PERIOD = 10.0


class UnheardPoses:
    """Watches the pose topics of the solids that are not moved by poses.

    Nothing subscribes to them, so that a viewer does not offer such a solid for dragging; that
    somebody publishes there is seen all the same.
    """

    def __init__(self, node):
        """Args: the node whose `~/solids/<solid>/pose` it is about."""
        self._node = node
        self._found = {}

    def look(self, solids):
        """Warn of publishers on pose topics of SolidSpecs that poses do not move."""
        self._found = {}
        for solid in solids:
            topic = f"~/solids/{solid.name}/pose"
            if solid.control == "topic" or not self._node.count_publishers(topic):
                continue
            text = f"poses refused: {WHY[solid.control]}; `control: topic` would let them move it"
            self._found[solid.name] = text
            self._node.get_logger().warning(
                f"{solid.name}: {text}", throttle_duration_sec=WARNING_PERIOD
            )

    def statuses(self):
        """A DiagnosticStatus for every solid that somebody tries to move in vain."""
        name = self._node.get_name()
        return [
            solid_status(DiagnosticStatus.WARN, name, solid, text, {"follows_poses": False})
            for solid, text in self._found.items()
        ]
