# SPDX-License-Identifier: Apache-2.0
"""A running simulation, or the recorded bag of one, as a video and its last picture."""

from dataclasses import replace

import numpy as np

from msg_adapters.bags import open_bag
from msg_adapters.header import NANOSECONDS
from msg_adapters.marker import cdr_to_markers
from msg_adapters.point_cloud import cdr_to_particle_cloud
from sph_ros.colors import liquid_color, solid_colors
from sph_ros.core.surface import extract_surface
from sph_ros.render import Camera, Frame, SolidView, render, save_png
from sph_ros.render.video import VideoWriter
from sph_ros.sim.liquid import Families
from sph_ros.sim.shapes import Container, Plane, display_mesh


class Film:
    """Draws states of a scene one after the other; a context manager.

    The camera stands so that the liquid, the emitters and all visible solids of the first state are
    in view, and the solids that follow paths wherever these lead.

    Args:
        scene: the Scene.
        video: path of the .mp4 to write.
        picture: path of a .png for the last state.
        size: (width, height) [pixels].
        fps: pictures per second.
    """

    def __init__(self, scene, video, picture, size, fps):
        self._scene, self._size = scene, size
        self._video, self._picture_path = VideoWriter(video, size, fps), picture
        self._solids = _Solids(scene)
        self._families = Families(scene) if len(scene.liquids) > 1 else None
        self._camera = self._floor = self._picture = None

    def __enter__(self):
        self._video.__enter__()
        return self

    def __exit__(self, *exception):
        self._video.__exit__(*exception)
        if exception[0] is None and self._picture is not None:
            save_png(self._picture_path, self._picture)

    def add(self, positions, velocities, surface, poses, ids=None):
        """Draw a state.

        Args:
            positions: of the particles [m], (N, 3).
            velocities: [m/s], (N, 3).
            surface: of the liquid: (vertices, triangles, normals).
            poses: name -> (position, quat_xyzw) of solids; those without one are not drawn.
            ids: of the particles, (N,), which say what liquid they are of.
        """
        scene = self._scene
        views = self._solids.views(poses)
        frame = Frame(
            positions,
            velocities,
            tuple(surface),
            views,
            scene.spacing,
            dimension=scene.dimension,
            colours=self._colours(len(positions), ids),
        )
        if self._camera is None:
            bounds = self._solids.bounds(frame, scene.emitters)
            self._camera = Camera.fit(*bounds, aspect=self._size[0] / self._size[1])
            self._floor = bounds[0][2]
        # A floor under what is there now would jump; but nothing may sink into it.
        self._floor = min(self._floor, frame.bounds()[0][2])
        frame = replace(frame, floor_z=float(self._floor))
        self._picture = render(frame, self._camera, self._size)
        self._video.add(self._picture)

    def _colours(self, count, ids):
        """Red, green, blue of each of `count` particles, None for a clear liquid."""
        if ids is not None and self._families is not None:
            table = [liquid_color(material)[:3] for material in self._scene.liquids]
            return np.array(table)[self._families.of(ids)]
        color = self._scene.material.color
        return None if color is None else np.tile(np.array(color), (count, 1))


class _Solids:
    """Meshes and colours of a scene's visible solids, looked up once."""

    def __init__(self, scene):
        self._specs = {spec.name: spec for spec in scene.solids if spec.visible}
        self._meshes = {name: display_mesh(spec.shape) for name, spec in self._specs.items()}
        self._colors = solid_colors(scene)

    def views(self, poses):
        """The visible solids that have a pose."""
        return [
            SolidView(
                name,
                *self._meshes[name],
                *poses[name],
                container=isinstance(spec.shape, Container),
                wireframe=spec.see_through,
                color=self._colors[name][:3],
            )
            for name, spec in self._specs.items()
            if name in poses
        ]

    def bounds(self, frame, emitters):
        """(lower, upper) corner [m] of all but planes, which are endless; with paths and jets."""
        points = [np.array(frame.bounds()) if len(frame.positions) else np.empty((0, 3))]
        for emitter in emitters:
            points.append(np.array(emitter.position) + [[-emitter.radius], [emitter.radius]])
        for view in frame.solids:
            spec = self._specs[view.name]
            if not isinstance(spec.shape, Plane):
                corners = view.world_vertices()
                points.append(corners)
                # Where its path takes it; how it is turned there hardly matters.
                shifts = [np.array(key.position) - view.position for key in spec.path]
                points += [np.stack([corners.min(axis=0), corners.max(axis=0)]) + s for s in shifts]
        points = np.concatenate(points)
        return points.min(axis=0), points.max(axis=0)


# ---------------------------------------------------------------- from a bag


def film_of_bag(bag, scene, video, picture, size, fps, progress=lambda done, total: None):
    """Draw the particles and solids of a recording with `/fluid/particles` and `/fluid/solids`.

    The video runs at the speed of the simulation: a liquid that was computed slower than real time
    is shown at its true speed.

    Args:
        bag: path of the recording.
        scene: the Scene that ran.
        video, picture, size, fps: as for `Film`.
        progress: called with (pictures drawn, pictures in all).

    Returns:
        number of pictures.
    """
    with open_bag(bag) as reader, Film(scene, video, picture, size, fps) as film:
        clouds = _chosen_clouds(reader, fps)
        poses = [_poses(message.data) for message in reader.messages(["/fluid/solids"])]
        times = np.array([stamp for stamp, _ in poses])
        for done, (stamp_ns, data) in enumerate(clouds, start=1):
            cloud = cdr_to_particle_cloud(data)
            surface = extract_surface(
                cloud.positions, scene.spacing, scene.support_radius, dimension=scene.dimension
            )
            nearest = int(np.argmin(np.abs(times - stamp_ns)))
            film.add(cloud.positions, cloud.velocities, surface, poses[nearest][1], cloud.ids)
            progress(done, len(clouds))
    return len(clouds)


def _chosen_clouds(reader, fps):
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
    """(stamp [ns], {solid: (position, quat_xyzw)}) of an array of markers."""
    markers = cdr_to_markers(data)
    stamp = markers[0].stamp_ns if markers else 0
    return stamp, {marker.namespace: (marker.position, marker.quat_xyzw) for marker in markers}
