# SPDX-License-Identifier: Apache-2.0
"""What the viewer says of the fluid node to people, and of itself to diagnostic tools."""

import math

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

#: A pose older than this [s] means that nobody moves the solid.
OLD_POSE = 60.0


def state_rows(facts):
    """(name, value) rows for the panel from the fluid's diagnostics, key -> text."""
    particles = f"{int(facts['particles']):,}"
    if facts["lost_particles"] != "0":
        particles += f", {facts['lost_particles']} lost"
    compression = 100.0 * float(facts["mean_compression"])
    rows = [
        ("particles", particles),
        ("real time", f"{float(facts['real_time_factor']):.2f} ×"),
        ("step", f"{float(facts['step_time_ms']):.2f} ms"),
        ("surface", f"{float(facts['surface_time_ms']):.2f} ms"),
        ("compression", "-" if math.isnan(compression) else f"{compression:.2f} %"),
    ]
    for key, text in facts.items():
        if key.startswith("pose_age_"):
            rows.append((f"pose of {key.removeprefix('pose_age_')}", pose_text(float(text))))
    return rows


def pose_text(age):
    """How long ago [s] a pose came; NaN for never."""
    if math.isnan(age):
        return "none yet"
    return f"{age:.2f} s ago" if age < OLD_POSE else "over a minute ago"


def away_text(name, silence):
    """Why there are no numbers; `silence` [s] is None before the first report."""
    if silence is None:
        return f"waiting for the fluid node {name} ..."
    return f"no word from {name} for {silence:.0f} s"


def viewer_status(browsers, drawn, undrawable):
    """A DiagnosticStatus of the viewer.

    Args:
        browsers: that look.
        drawn: topic -> messages drawn in the last second.
        undrawable: messages that could not be drawn, since the start.
    """
    facts = {
        "browsers": browsers,
        **{f"drawn_{name}_hz": count for name, count in drawn.items()},
        "undrawable_messages": undrawable,
    }
    return DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name="web_viewer: page",
        message=f"{browsers} browsers" if browsers != 1 else "1 browser",
        values=[KeyValue(key=key, value=str(value)) for key, value in facts.items()],
    )
