# SPDX-License-Identifier: Apache-2.0
"""What the tracker sees, drawn into its picture."""

import math

import cv2
import numpy as np

_COLORS = {  # BGR
    "tracking": (60, 220, 60),
    "coasting": (0, 200, 255),
    "lost": (60, 60, 255),
    "never seen": (160, 160, 160),
    "no world": (160, 160, 160),
}
_AXES = ((0, 0, 255), (0, 255, 0), (255, 0, 0))


def draw_tracking(picture, tracking, targets, camera, notes=()):
    """Outlines and ids of markers, axes of targets, one line of text for each target and note.

    Args:
        picture: (H, W, 3) uint8 BGR, changed.
        tracking: Tracking of this picture.
        targets: name -> Target.
        camera: CameraModel.
        notes: lines of text.

    Returns:
        The picture.
    """
    for region in tracking.regions or ():
        cv2.rectangle(picture, region[:2], region[2:], (120, 120, 120), 1)
    for detection in tracking.detections:
        _outline(picture, detection)
    everything = list(tracking.solids.values())
    if tracking.world is not None:
        everything.insert(0, tracking.world)
    for line, tracked in enumerate(everything):
        if tracked.in_camera is not None:
            _axes(picture, tracked.in_camera, 0.5 * _extent(targets[tracked.name]), camera)
        _text(picture, line, _describe(tracked), _COLORS[tracked.status])
    notes = (*(problem.text for problem in tracking.problems), *notes)
    for line, note in enumerate(notes, start=len(everything)):
        _text(picture, line, note, (80, 160, 255))
    return picture


def draw_notes(picture, notes):
    """Lines of text alone, for a picture that could not be used."""
    for line, note in enumerate(notes):
        _text(picture, line, note, (80, 160, 255))
    return picture


def _describe(tracked):
    parts = [f"{tracked.name}: {tracked.status}"]
    if math.isfinite(tracked.residual):
        parts.append(f"{tracked.residual:.2f} px")
    elif math.isfinite(tracked.age):
        parts.append(f"{tracked.age:.2f} s ago")
    if len(tracked.motion) == 3:
        parts.append(("rest", "glide", "jerk")[int(np.argmax(tracked.motion))])
    if tracked.rejected:
        parts.append(f"{tracked.rejected} refused")
    return ", ".join(parts)


def _outline(picture, detection):
    corners = np.round(detection.corners).astype(np.int32)
    cv2.polylines(picture, [corners], True, (255, 0, 255), 2, cv2.LINE_AA)
    cv2.circle(picture, tuple(map(int, corners[0])), 4, (0, 255, 255), -1, cv2.LINE_AA)
    where = tuple(map(int, corners.mean(axis=0)))
    cv2.putText(picture, str(detection.id), where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 0, 255), 2)


def _axes(picture, pose, length, camera):
    ends = pose.apply(length * np.vstack([np.zeros(3), np.eye(3)]))
    if ends[:, 2].min() <= 0.01:
        return
    pixels = camera.project(ends)
    if np.abs(pixels).max() > 1e5:
        return
    origin, *tips = (tuple(map(int, p)) for p in np.round(pixels))
    for tip, color in zip(tips, _AXES, strict=True):
        cv2.line(picture, origin, tip, color, 2, cv2.LINE_AA)


def _extent(target):
    points = target.points(target.ids)
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def _text(picture, line, text, color):
    x, y = 8, 20 + 18 * line
    # Thick letters behind would be wider ones in OpenCV 5, so four thin ones make the outline.
    for place in ((x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)):
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA)
