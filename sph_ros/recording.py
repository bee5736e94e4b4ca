# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: a folder that appears when it is complete, a bag, a table."""

import csv
import os
import shutil
from pathlib import Path

import numpy as np

from msg_adapters.bags import BagWriter
from msg_adapters.marker import MARKER, MARKER_ARRAY, marker_to_cdr, markers_to_cdr
from msg_adapters.point_cloud import POINT_CLOUD2, point_cloud_to_cdr
from msg_adapters.pose import POSE_STAMPED, pose_to_cdr
from msg_adapters.wrench import WRENCH_STAMPED, wrench_to_cdr
from sph_ros.scene_markers import SolidMarkers, surface_color, surface_marker

NODE = "/fluid"

#: Of `Simulation.statistics()`, what the table and the plot show.
STATISTICS = (
    "time",
    "particle_count",
    "emitted_particles",
    "removed_particles",
    "lost_particles",
    "mean_compression",
    "max_compression",
    "kinetic_energy",
    "mean_speed",
    "max_speed",
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
        self.path = self.target.with_name(f".{self.target.name}.{os.getpid()}")
        self.path.mkdir()
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

    def __init__(self, folder, sim, start_ns):
        self._folder, self._frame_id, self._start_ns = Path(folder), sim.scene.frame, start_ns
        self._sim, self._solids = sim, SolidMarkers(sim)
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

    def add(self, surface):
        """Record the present state; `surface` is (vertices, triangles, normals)."""
        sim = self._sim
        stamp = self._start_ns + round(sim.time * 1e9)

        def write(topic, message_type, data):
            self._bag.write(f"{NODE}/{topic}", message_type, stamp, data)

        cloud = point_cloud_to_cdr(sim.particles, stamp, self._frame_id)
        write("particles", POINT_CLOUD2, cloud)
        for name in sim.solid_names:
            solid = sim.solid(name)
            if solid.control != "fixed":
                pose = pose_to_cdr(solid.position, solid.quat_xyzw, stamp, self._frame_id)
                write(f"solids/{name}/pose", POSE_STAMPED, pose)
            wrench = wrench_to_cdr(*sim.wrench(name), stamp, self._frame_id)
            write(f"solids/{name}/wrench", WRENCH_STAMPED, wrench)
        if self._count % 2 == 0:
            liquids = [sim.material, *sim.scene.liquids[1:]]
            color = surface_color(liquids, surface[0], sim.positions, sim.families)
            marker = surface_marker(*surface, stamp, self._frame_id, color)
            write("surface", MARKER, marker_to_cdr(marker))
            write("solids", MARKER_ARRAY, markers_to_cdr(self._solids.at(stamp)))
        self._count += 1


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
