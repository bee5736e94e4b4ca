# SPDX-License-Identifier: Apache-2.0
"""How the fluid node is, once a second, for people and for diagnostic tools."""

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from msg_adapters.header import split_stamp
from sph_ros.nodes.poses import REASONS

#: Less of the wanted speed is called slow.
SLOW = 0.95


class Speedometer:
    """Simulated per real time and the cost of a step, between two readings.

    Args:
        runner: a Runner.
    """

    def __init__(self, runner):
        self._runner = runner
        self._mark = self._now()

    def _now(self):
        runner = self._runner
        return time.monotonic(), runner.steps, runner.busy

    def read(self):
        """Since the last reading: real-time factor, mean milliseconds of a step (0 without one)."""
        before, self._mark = self._mark, self._now()
        seconds, steps, busy = (b - a for a, b in zip(before, self._mark, strict=True))
        factor = steps * self._runner.sim.time_step / seconds if seconds > 0.0 else 0.0
        return factor, 1e3 * busy / steps if steps else 0.0


def judge(facts):
    """Level and one line from the facts of `fluid_status`."""
    if facts["fault"]:
        return DiagnosticStatus.ERROR, f"stopped: {facts['fault']}; call ~/reset"
    complaints = []
    if facts["lost_particles"] > 0:
        complaints.append(f"{facts['lost_particles']} particles lost")
    if facts["state"] == "running" and facts["real_time_factor"] < SLOW * facts["wanted_factor"]:
        complaints.append(
            f"slow: {facts['real_time_factor']:.2f} of {facts['wanted_factor']:g} times real time"
        )
    if complaints:
        return DiagnosticStatus.WARN, ", ".join(complaints)
    return DiagnosticStatus.OK, facts["state"]


def fluid_status(name, scene, facts):
    """A DiagnosticStatus of the simulation.

    Args:
        name: of the node.
        scene: a Scene.
        facts: name -> value; in any case fault, state, real_time_factor, wanted_factor and
            lost_particles.
    """
    level, message = judge(facts)
    return _status(level, f"{name}: simulation", message, scene.name, facts)


def pose_status(name, gate, refused_before):
    """A DiagnosticStatus of the poses of one solid; a warning while poses are being refused."""
    refused = sum(gate.refused.values())
    level, message = DiagnosticStatus.OK, "poses arrive"
    if refused > refused_before:
        level = DiagnosticStatus.WARN
        message = f"{refused - refused_before} poses refused since the last report"
    elif gate.accepted == 0:
        message = "no pose yet"
    facts = {
        "pose_age": gate.age,
        "poses_accepted": gate.accepted,
        "poses_refused": refused,
        **{f"refused_{reason}": gate.refused[reason] for reason in REASONS},
    }
    return solid_status(level, name, gate.solid, message, facts)


def solid_status(level, name, solid, message, facts):
    """A DiagnosticStatus of one solid of the node `name`."""
    return _status(level, f"{name}: solid {solid}", message, solid, facts)


def diagnostic_array(stamp_ns, frame, statuses):
    """The message for /diagnostics."""
    array = DiagnosticArray(status=statuses)
    array.header.stamp.sec, array.header.stamp.nanosec = split_stamp(stamp_ns)
    array.header.frame_id = frame
    return array


def _status(level, name, message, hardware_id, facts):
    values = [KeyValue(key=key, value=_text(value)) for key, value in facts.items()]
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id=hardware_id, values=values
    )


def _text(value):
    return f"{value:.6g}" if isinstance(value, float) else str(value)
