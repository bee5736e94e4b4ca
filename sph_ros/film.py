# SPDX-License-Identifier: Apache-2.0
"""A recorded bag of a fluid node as a video."""

import numpy as np

from msg_adapters.bags import open_bag
from msg_adapters.header import NANOSECONDS
from msg_adapters.marker import cdr_to_markers
from msg_adapters.point_cloud import cdr_to_particle_cloud
from sph_ros.core.surface import extract_surface
from sph_ros.render import Camera, Frame, SolidView, render, save_png
from sph_ros.render.video import VideoWriter
from sph_ros.sim.shapes import Container, display_mesh


def make_film(bag, scene, video, picture, fps, size, progress=lambda done, total: None):
    """Draw the particles and solids of a bag.

    The video runs at the speed of the simulation: a liquid that was computed slower than real time
    is shown at its true speed.

    Args:
        bag: path of a recording with `/fluid/particles` and `/fluid/solids`.
        scene: the Scene that ran.
        video: path of the .mp4 to write.
        picture: path of a .png for the last frame.
        fps: pictures per second of simulated time.
        size: (width, height) [pixels].
        progress: called with (frames drawn, frames in all).

    Returns:
        number of frames.
    """
    solids = _Solids(scene)
    with open_bag(bag) as reader:
        clouds = _frames(reader, fps)
        poses = [_poses(m.data) for m in reader.messages(["/fluid/solids"])]
        times = np.array([stamp for stamp, _ in poses])
        camera = last = None
        with VideoWriter(video, size, fps) as writer:
            for done, (stamp_ns, data) in enumerate(clouds, start=1):
                cloud = cdr_to_particle_cloud(data)
                nearest = int(np.argmin(np.abs(times - stamp_ns)))
                frame = _frame(scene, cloud, solids.views(poses[nearest][1]))
                if camera is None:
                    camera = Camera.fit(*frame.bounds(), aspect=size[0] / size[1])
                last = render(frame, camera, size)
                writer.add(last)
                progress(done, len(clouds))
    save_png(picture, last)
    return len(clouds)


def _frames(reader, fps):
    """For every picture (stamp, bytes) of the newest cloud at its time; time never goes back."""
    chosen, tick = [], None
    for message in reader.messages(["/fluid/particles"]):
        stamp = int.from_bytes(message.data[4:8], "little") * NANOSECONDS
        stamp += int.from_bytes(message.data[8:12], "little")
        tick = stamp if tick is None else tick
        while stamp >= tick:
            chosen.append((stamp, message.data))
            tick += round(NANOSECONDS / fps)
    return chosen


def _poses(data):
    markers = cdr_to_markers(data)
    stamp = markers[0].stamp_ns if markers else 0
    return stamp, {marker.namespace: marker for marker in markers}


def _frame(scene, cloud, views):
    surface = extract_surface(
        cloud.positions, scene.spacing, scene.support_radius, dimension=scene.dimension
    )
    return Frame(
        cloud.positions,
        cloud.velocities,
        tuple(surface),
        views,
        scene.spacing,
        dimension=scene.dimension,
    )


class _Solids:
    """Meshes of a scene's visible solids, looked up once."""

    def __init__(self, scene):
        self._specs = [spec for spec in scene.solids if spec.visible]
        self._meshes = {spec.name: display_mesh(spec.shape) for spec in self._specs}

    def views(self, markers):
        """The solids where their markers are."""
        return [
            SolidView(
                spec.name,
                *self._meshes[spec.name],
                position=markers[spec.name].position,
                quat_xyzw=markers[spec.name].quat_xyzw,
                container=isinstance(spec.shape, Container),
                color=spec.color,
            )
            for spec in self._specs
            if spec.name in markers
        ]
