# SPDX-License-Identifier: Apache-2.0
"""`sph_ros simulate`: a scene and a recorded bag, offline, as fast as the machine allows."""

import os
import signal
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from sph_ros.core.surface import extract_surface
from sph_ros.film import Film
from sph_ros.recording import BagRecorder, History, ResultFolder
from sph_ros.render.plots import plot_history
from sph_ros.sim.scene import bag_path, load_scene
from sph_ros.sim.simulation import Simulation
from sph_ros.tracks import read_tracks
from sph_ros.waiting import preparing, warm_up

DEFAULT_SECONDS = 5.0


class SimulateError(ValueError):
    """A run cannot start; one line that says why."""


@dataclass(frozen=True)
class Summary:
    """How a run ended.

    Attributes:
        out: the folder with the results.
        complete: False after Ctrl-C.
        simulated: [s].
        wanted: [s].
        wall: time it took [s].
        frames: recorded.
        particle_count: at the end.
    """

    out: Path
    complete: bool
    simulated: float
    wanted: float
    wall: float
    frames: int
    particle_count: int

    def __str__(self):
        """One or two lines for people."""
        speed = self.simulated / self.wall if self.wall > 0 else 0.0
        text = (
            f"{self.out}: {self.simulated:.2f} s, {self.frames} frames, "
            f"{self.particle_count:,} particles, {speed:.2f} x real time with recording"
        )
        if not self.complete:
            text = f"interrupted at {self.simulated:.2f} of {self.wanted:g} s, kept\n{text}"
        return text


def simulate(
    scene,
    out=None,
    *,
    bag=None,
    remaps=None,
    ignore_frame=False,
    seconds=None,
    fps=30.0,
    size=(960, 720),
    force=False,
):
    """Run a scene and leave result.mcap, history.csv, history.png and perhaps a video in a folder.

    The same scene and bag give the same bytes. Ctrl-C ends the run early and keeps what there is.

    Args:
        scene: as for `load_scene`.
        out: folder to make; None for out/SCENE.
        bag: packaged name or path of a recording that moves solids, see `read_tracks`.
        remaps: topic of the bag -> solid.
        ignore_frame: take poses in any frame as the scene's frame.
        seconds: how long [s]; None for the bag's length, else the scene's, or DEFAULT_SECONDS.
        fps: recorded frames per second.
        size: of the video (width, height) [pixels], None for no video and no picture.
        force: replace results that are in the folder already.

    Returns:
        A Summary.

    Raises:
        SceneError, BagError, SimulateError: before anything is written.
    """
    with preparing():
        scene = load_scene(scene)
        tracks, start_ns = [], 0
        if bag is not None:
            tracks, start_ns = read_tracks(bag_path(bag), scene, remaps, ignore_frame)
        elif remaps:
            raise SimulateError("--remap needs a --bag whose topics it can remap")
        out = Path("out") / scene.name if out is None else Path(out)
        _check_folder(out, force)
        sim = Simulation(scene)
        warm_up(sim)
    wanted = seconds or max((float(track.times[-1]) for track in tracks), default=0.0)
    wanted = wanted or scene.duration or DEFAULT_SECONDS
    for track in tracks:
        for moment, position, quat_xyzw in zip(*track[1:], strict=True):
            sim.move_solid(track.solid, position, quat_xyzw, time=float(moment))
    start = time.perf_counter()
    with ResultFolder(out) as folder:
        frames, complete = _run(sim, folder.path, start_ns, wanted, fps, size)
    wall = time.perf_counter() - start
    return Summary(out, complete, sim.time, wanted, wall, frames, len(sim.positions))


def _run(sim, folder, start_ns, wanted, fps, size):
    """Step and record; returns (frames, whether it reached the end)."""
    history, complete, frames = History(), True, 1
    frame_count = int(wanted * fps + 1e-6) + 1
    with ExitStack() as stack:
        stopped = stack.enter_context(_ctrl_c())
        bag = stack.enter_context(BagRecorder(folder, sim, start_ns))
        film = stack.enter_context(_film(sim.scene, folder, size, fps)) if size else None
        with preparing():  # drawing has its own kernels
            _record(sim, bag, history, film)
        bar = tqdm(total=wanted, unit="s", disable=None, leave=False, bar_format=_BAR)
        stack.enter_context(bar)
        while frames < frame_count:
            _advance_to(sim, frames / fps, stopped)
            if stopped.is_set():
                complete = False
                break
            _record(sim, bag, history, film)
            frames += 1
            bar.update(min(sim.time, wanted) - bar.n)
    history.write_csv(folder / "history.csv")
    plot_history(folder / "history.png", history.arrays(), sim.scene.name)
    return frames, complete


def _record(sim, bag, history, film):
    """The present state into all that a run leaves behind."""
    scene = sim.scene
    surface = extract_surface(
        sim.positions, scene.spacing, scene.support_radius, dimension=scene.dimension
    )
    bag.add(surface)
    history.add(sim)
    if film:
        film.add(sim.positions, sim.velocities, surface, _poses(sim), sim.ids)


_BAR = "{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated, {elapsed} gone, {remaining} to go"


def _film(scene, folder, size, fps):
    return Film(scene, folder / "video.mp4", folder / "last.png", size, fps)


def _poses(sim):
    """Of all solids: name -> (position, quat_xyzw)."""
    solids = [sim.solid(name) for name in sim.solid_names]
    return {solid.name: (solid.position, solid.quat_xyzw) for solid in solids}


def _advance_to(sim, moment, stopped):
    """Whole steps until `moment` [s], to the nearest step."""
    while sim.time < moment - 0.5 * sim.time_step and not stopped.is_set():
        sim.step()


@contextmanager
def _ctrl_c():
    """An event that the first Ctrl-C (or SIGTERM) sets; the second ends the program as usual.

    A flag and not an exception, so that no message or video frame is cut in half.
    """
    stopped = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return
    before = {}

    def stop(number, _frame):
        stopped.set()
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, stop)
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_folder(out, force):
    """Refuse targets that are no folder, or hold something."""
    if out.exists() and not out.is_dir():
        raise SimulateError(f"{out}: is a file, expected a folder to make")
    if out.is_dir() and any(out.iterdir()) and not force:
        raise SimulateError(f"{out}: is not empty; --force replaces the results in it")
    parent = out.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not os.access(parent, os.W_OK):
        raise SimulateError(f"{out}: cannot be made, {parent} is not writable")
