# SPDX-License-Identifier: Apache-2.0
"""Recorded poses as the motion of a scene's solids: which topic moves which solid, and when."""

from typing import NamedTuple

import numpy as np

from msg_adapters.bags import BagError, open_bag, read_poses
from msg_adapters.pose import POSE_STAMPED
from sph_ros.sim.scene import SceneError
from sph_ros.sim.scene_yaml import nearest


class Track(NamedTuple):
    """The recorded motion of one solid.

    Attributes:
        solid: its name.
        times: since the first message of the bag's chosen topics, by header stamps [s], (N,).
        positions: [m], (N, 3).
        quats_xyzw: (N, 4).
    """

    solid: str
    times: np.ndarray
    positions: np.ndarray
    quats_xyzw: np.ndarray


def read_tracks(path, scene, remaps=None, ignore_frame=False):
    """The tracks of a bag for a scene, and the stamp that is their time zero.

    Args:
        path: of the bag.
        scene: a Scene.
        remaps: topic of the bag -> solid, or the topic of the solid's pose. Topics that are not
            named go by their name, `.../solids/NAME/pose`; where nothing fits, the only topic of
            poses moves the only solid with `control: topic`.
        ignore_frame: accept poses in any frame.

    Returns:
        (tracks, start_ns).

    Raises:
        BagError: the bag cannot be used, or it does not fit the scene.
        SceneError: no solid of the scene follows a topic.
    """
    pairs = _pairs(path, scene, remaps or {})
    recorded = {solid: read_poses(path, topic) for topic, solid in pairs}
    for topic, solid in pairs:
        frame = recorded[solid].frame_id
        if frame not in ("", scene.frame) and not ignore_frame:
            raise BagError(
                f"{path}: {topic} is in frame {frame!r}, expected {scene.frame!r} as in "
                f"{scene.source}; --ignore-frame takes it as that"
            )
        _check_values(path, topic, recorded[solid])
    start_ns = min(int(poses.stamps_ns[0]) for poses in recorded.values())
    tracks = [
        Track(solid, (poses.stamps_ns - start_ns) * 1e-9, poses.positions, poses.quats_xyzw)
        for solid, poses in recorded.items()
    ]
    return tracks, start_ns


def _check_values(path, topic, poses):
    """Refuse what no solid can be moved to."""
    good = np.isfinite(poses.positions).all(axis=1) & np.isfinite(poses.quats_xyzw).all(axis=1)
    good &= np.abs(poses.quats_xyzw).max(axis=1, initial=0.0) > 1e-6
    if not good.all():
        raise BagError(
            f"{path}: {topic} has {int((~good).sum())} poses that are not finite or have a zero "
            f"quaternion, the first is message {int(np.argmin(good))}"
        )


def _pairs(path, scene, remaps):
    """[(topic, solid)], every solid at most once."""
    driven = [solid.name for solid in scene.solids if solid.control == "topic"]
    if not driven:
        raise SceneError(f"{scene.source}: no solid with `control: topic`, so no bag can move any")
    with open_bag(path) as bag:
        for topic in remaps:
            bag.require(topic, POSE_STAMPED)
        names = {name.lstrip("/"): name for name in bag.topics}
        pairs = [(names[t.lstrip("/")], _solid(path, s, driven)) for t, s in remaps.items()]
        taken = {topic for topic, _ in pairs}
        for topic in bag.topics.values():
            solid = _solid_in(topic.name)
            if topic.type == POSE_STAMPED and topic.count and topic.name not in taken:
                if solid in driven:
                    pairs.append((topic.name, solid))
        if not pairs:
            topic = bag.only_topic(POSE_STAMPED)
            if len(driven) > 1:
                raise BagError(
                    f"{path}: {topic.name} could move {', '.join(driven)}; "
                    f"say which: --remap {topic.name}:={driven[0]}"
                )
            pairs = [(topic.name, driven[0])]
    solids = [solid for _, solid in pairs]
    for solid in solids:
        if solids.count(solid) > 1:
            topics = ", ".join(topic for topic, other in pairs if other == solid)
            raise BagError(f"{path}: {solid} can follow one topic, got {topics}")
    return pairs


def _solid(path, target, driven):
    """The solid that a remap means."""
    name = _solid_in(target) or target
    if name not in driven:
        raise BagError(f"{path}: no solid {name!r} that follows a topic{nearest(name, driven)}")
    return name


def _solid_in(topic):
    """NAME of `.../solids/NAME/pose`, else None."""
    parts = topic.strip("/").split("/")
    return parts[-2] if len(parts) >= 3 and parts[-3] == "solids" and parts[-1] == "pose" else None
