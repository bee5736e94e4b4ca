# SPDX-License-Identifier: Apache-2.0
"""What an offline run leaves behind: a bag, a video with its last picture, a table and a plot."""

import csv
import shutil
import tempfile
from pathlib import Path

import numpy as np

from msg_adapters.bags import BagWriter
from msg_adapters.marker import (
    MARKER,
    MARKER_ARRAY,
    delete_marker,
    marker_to_cdr,
    markers_to_cdr,
    triangle_marker,
)
from msg_adapters.point_cloud import POINT_CLOUD2, particle_cloud_to_cdr
from msg_adapters.pose import POSE_STAMPED, pose_to_cdr
from msg_adapters.wrench import WRENCH_STAMPED, wrench_to_cdr
from sph_ros.render import Camera, Frame, SolidView, render, save_png
from sph_ros.render.video import VideoWriter
from sph_ros.sim.shapes import Container, Plane

NODE = "/fluid"
LIQUID_COLOR = (0.20, 0.45, 0.75, 0.8)
SOLID_COLOR = (0.85, 0.45, 0.20, 1.0)
CONTAINER_COLOR = (0.7, 0.7, 0.7, 0.15)

#: Of `Simulation.statistics()`, what the table and the plot show.
STATISTICS = (
    "time",
    "particle_count",
    "lost_particles",
    "mean_compression",
    "max_compression",
    "kinetic_energy",
    "momentum",
)


class ResultFolder:
    """A folder whose files appear all at once, when they are complete.

    A context manager; `path` is a hidden folder beside the target meanwhile, which is deleted when
    the block ends with an exception.
    """

    def __init__(self, target):
        self.target = Path(target).absolute()

    def __enter__(self):
        self.target.parent.mkdir(parents=True, exist_ok=True)
        folder = tempfile.mkdtemp(prefix=f".{self.target.name}.", dir=self.target.parent)
        self.path = Path(folder)
        self.path.chmod(0o755)  # mkdtemp's folders are for the owner alone
        return self

    def __exit__(self, exception_type, *_):
        try:
            if exception_type is None:
                if self.target.is_dir():  # other files in there stay as they are
                    for file in self.path.iterdir():
                        file.replace(self.target / file.name)
                else:
                    self.path.rename(self.target)
        finally:
            shutil.rmtree(self.path, ignore_errors=True)


class BagRecorder:
    """Writes what `fluid_node` would publish into DIR, which becomes a rosbag2 folder.

    Particles, wrenches and poses go in every frame, the surface and the solids every second one:
    they are large.
    """

    def __init__(self, folder, scene, start_ns):
        self._folder, self._frame_id, self._start_ns = Path(folder), scene.frame, start_ns
        self._visible = {solid.name: solid.visible for solid in scene.solids}
        self._count = 0

    def __enter__(self):
        self._bag = BagWriter(self._folder / "result").__enter__()
        return self

    def __exit__(self, *exception):
        self._bag.__exit__(*exception)
        if exception[0] is None:
            for file in (self._folder / "result").iterdir():
                file.replace(self._folder / file.name)
            (self._folder / "result").rmdir()

    def add(self, sim, surface):
        """Record the present state; `surface` is (vertices, triangles, normals)."""
        stamp = self._start_ns + round(sim.time * 1e9)

        def write(topic, message_type, data):
            self._bag.write(f"{NODE}/{topic}", message_type, stamp, data)

        cloud = particle_cloud_to_cdr(
            sim.positions, sim.velocities, sim.densities, sim.ids, stamp, self._frame_id
        )
        write("particles", POINT_CLOUD2, cloud)
        for name in sim.solid_names:
            solid = sim.solid(name)
            if solid.control != "fixed":
                pose = pose_to_cdr(solid.position, solid.quat_xyzw, stamp, self._frame_id)
                write(f"solids/{name}/pose", POSE_STAMPED, pose)
            wrench = wrench_to_cdr(*sim.wrench(name), stamp, self._frame_id)
            write(f"solids/{name}/wrench", WRENCH_STAMPED, wrench)
        if self._count % 2 == 0:
            write("surface", MARKER, self._surface(surface, stamp))
            write("solids", MARKER_ARRAY, self._solids(sim, stamp))
        self._count += 1

    def _surface(self, surface, stamp):
        vertices, triangles, _ = surface
        if len(triangles) == 0:
            return marker_to_cdr(delete_marker(stamp, self._frame_id, namespace="surface"))
        marker = triangle_marker(
            vertices, triangles, stamp, self._frame_id, namespace="surface", color=LIQUID_COLOR
        )
        return marker_to_cdr(marker)

    def _solids(self, sim, stamp):
        markers = []
        for index, name in enumerate(sim.solid_names):
            if not self._visible[name]:
                continue
            solid = sim.solid(name)
            vertices, triangles = solid.mesh()
            markers.append(
                triangle_marker(
                    vertices,
                    triangles,
                    stamp,
                    self._frame_id,
                    namespace=name,
                    marker_id=index,
                    color=solid_color(solid),
                    position=solid.position,
                    quat_xyzw=solid.quat_xyzw,
                )
            )
        return markers_to_cdr(markers)


def solid_color(solid):
    """Red, green, blue, alpha of a solid: the scene's, or one that suits it."""
    if isinstance(solid.shape, Container):
        return CONTAINER_COLOR
    return (*solid.color, 1.0) if solid.color is not None else SOLID_COLOR


class VideoRecorder:
    """Writes video.mp4 and, at the end, last.png; the camera stands so that all is in view."""

    def __init__(self, folder, sim, size, fps):
        self._folder, self._size, self._fps = Path(folder), size, fps
        lower, upper = view_bounds(sim)
        self._camera = Camera.fit(lower, upper, aspect=size[0] / size[1])
        self._picture = None

    def __enter__(self):
        path = self._folder / "video.mp4"
        self._video = VideoWriter(path, self._size, self._fps).__enter__()
        return self

    def __exit__(self, *exception):
        self._video.__exit__(*exception)
        if exception[0] is None and self._picture is not None:
            save_png(self._folder / "last.png", self._picture)

    def add(self, sim, surface):
        """Draw the present state; `surface` is (vertices, triangles, normals)."""
        self._picture = render(picture_frame(sim, surface), self._camera, self._size)
        self._video.add(self._picture)


def picture_frame(sim, surface=None):
    """What a picture of the present state shows."""
    visible = {spec.name for spec in sim.scene.solids if spec.visible}
    views = []
    for solid in (sim.solid(name) for name in sim.solid_names if name in visible):
        view = SolidView(
            solid.name,
            *solid.mesh(),
            position=solid.position,
            quat_xyzw=solid.quat_xyzw,
            container=isinstance(solid.shape, Container),
            color=solid.color,
        )
        views.append(view)
    return Frame(sim.positions, sim.velocities, surface, views, sim.scene.spacing)


def view_bounds(sim):
    """(lower, upper) corner of what a picture should show [m]: liquid and visible solids.

    Planes are endless and do not count.
    """
    frame = picture_frame(sim)
    points = [np.array(frame.bounds())]
    for view in frame.solids:
        if not isinstance(sim.solid(view.name).shape, Plane):
            points.append(view.world_vertices())
    points = np.concatenate(points)
    return points.min(axis=0), points.max(axis=0)


class History:
    """Numbers over time: a row per recorded frame."""

    def __init__(self):
        self._rows = []

    def add(self, sim):
        """Take the present numbers."""
        statistics = sim.statistics()
        row = {key: statistics[key] for key in STATISTICS}
        for name in sim.solid_names:
            row[f"force/{name}"], row[f"torque/{name}"] = sim.wrench(name)
        self._rows.append(row)

    def arrays(self):
        """Column -> (N,) or (N, 3) float64; `force/NAME` [N] and `torque/NAME` [N m] of solids."""
        return {key: np.array([row[key] for row in self._rows], float) for key in self._rows[0]}

    def write_csv(self, path):
        """A table with one line per frame; vectors take three columns."""
        columns = {}
        for key, values in self.arrays().items():
            if values.ndim == 1:
                columns[key] = values
            else:
                columns.update({f"{key}_{axis}": values[:, i] for i, axis in enumerate("xyz")})
        with open(path, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                writer.writerow([f"{value:.9g}" for value in row])
