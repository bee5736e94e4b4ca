# SPDX-License-Identifier: Apache-2.0
"""How the marker tracker is, once a second, for people and for diagnostic tools."""

import math
import threading
import time
from collections import Counter

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

#: A problem is reported for so long after it last occurred [s].
PROBLEM_TIME = 2.0

#: One that goes on is said again so often [s].
WARNING_PERIOD = 5.0


class Problems:
    """What went wrong lately, from any thread."""

    def __init__(self):
        self.counts = Counter()
        self._last, self._said = {}, {}
        self._lock = threading.Lock()

    def note(self, kind, text):
        """Keep a problem, of each kind the newest text; returns whether it should be said now."""
        now = time.monotonic()
        with self._lock:
            self.counts[kind] += 1
            self._last[kind] = (now, text)
            due = now - self._said.get(kind, -math.inf) >= WARNING_PERIOD
            if due:
                self._said[kind] = now
        return due

    def recent(self):
        """Texts of problems that are not over, by kind."""
        now = time.monotonic()
        with self._lock:
            return {
                kind: text for kind, (moment, text) in self._last.items()
                if now - moment < PROBLEM_TIME
            }  # fmt: skip


def input_status(node_name, state, facts, problems, idle):
    """A DiagnosticStatus of the pictures that come in.

    Args:
        node_name: of the node.
        state: one line for when all is well.
        facts: name -> value.
        problems: kind -> text of what is wrong now.
        idle: whether nobody listens.
    """
    level, message = DiagnosticStatus.OK, state
    if problems:
        hard = any(kind != "approximate" for kind in problems)
        level = DiagnosticStatus.ERROR if hard else DiagnosticStatus.WARN
        # What is wrong before what is only approximate.
        ordered = sorted(problems, key=lambda kind: kind == "approximate")
        message = "; ".join(problems[kind] for kind in ordered)
    elif idle:
        message = "idle: nobody listens"
    return _status(level, f"{node_name}: input", message, facts)


def target_status(node_name, name, tracked, is_world):
    """A DiagnosticStatus of a target; `tracked` is None before the first picture."""
    what = "world" if is_world else f"solid {name}"
    if tracked is None:
        return _status(DiagnosticStatus.OK, f"{node_name}: {what}", "no picture yet", {})
    good = tracked.status in ("tracking", "coasting")
    message = tracked.status
    if tracked.status == "no world":
        message = "the world marker is not seen, so its pose is not known"
    elif is_world and not good:
        message = f"world marker {tracked.status}: no poses without it"
    facts = {
        "age": tracked.age,
        "residual_pixels": tracked.residual,
        "measurements_refused": tracked.rejected,
    }
    if tracked.covariance is not None:
        facts["position_deviation"] = math.sqrt(max(0.0, tracked.covariance[:3, :3].trace()))
        facts["rotation_deviation"] = math.sqrt(max(0.0, tracked.covariance[3:, 3:].trace()))
    level = DiagnosticStatus.OK if good else DiagnosticStatus.WARN
    return _status(level, f"{node_name}: {what}", message, facts)


def _status(level, name, message, facts):
    values = [KeyValue(key=key, value=_text(value)) for key, value in facts.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=values)


def _text(value):
    return f"{value:.6g}" if isinstance(value, float) else str(value)
