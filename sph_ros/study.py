# SPDX-License-Identifier: Apache-2.0
"""`sph_ros study SCENE`: one question to a scene, answered by many runs at once.

The runs share nothing, so they go to whatever `concurrent.futures` executor there is: processes of
this machine unless told otherwise, or a cluster (Dask's `Client.get_executor()` is one).
"""

import csv
import dataclasses
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from sph_ros.dam_house import BEGIN, Case, Outcome, answer, run_case, scene_of, table
from sph_ros.recording import ResultFolder
from sph_ros.render.plots import plot_study
from sph_ros.sim.kernels import ensure_compiled, needs
from sph_ros.waiting import preparing

#: Scenes that a question belongs to.
STUDIES = ("dam_house_2d",)

HEIGHTS = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4)
POSITIONS = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5)


class StudyError(ValueError):
    """A study cannot run; one line that says why."""


def study(
    scene: str,
    heights: Iterable[float] = HEIGHTS,
    positions: Iterable[float] = POSITIONS,
    *,
    seconds: float | None = None,
    solver: str | None = None,
    workers: int | None = None,
    executor=None,
    out=None,
    force: bool = False,
    progress: Callable = tqdm,
) -> list[Outcome]:
    """For which walls does the house stay dry? Leaves study.csv and study.png in a folder.

    The outcomes do not depend on how many workers there are. Ctrl-C ends all of them and leaves
    nothing.

    Args:
        scene: one of STUDIES.
        heights: of the wall [m].
        positions: of the wall's left face, from the left end of the basin [m].
        seconds: how long each run is [s]; None: the scene's.
        solver: None: the scene's.
        workers: processes at once; None: one for each core.
        executor: where to run instead of processes of this machine.
        out: folder to make; None: out/study_SCENE.
        force: replace results that are in the folder already.
        progress: of tqdm's kind.

    Returns:
        Outcomes, positions first, then heights.

    Raises:
        StudyError: before anything runs, or when a process died.
    """
    if scene not in STUDIES:
        raise StudyError(f"{scene}: there is no study of this scene, only of {', '.join(STUDIES)}")
    out = Path("out") / f"study_{scene}" if out is None else Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())) and not force:
        raise StudyError(f"{out}: is there already; --force replaces the results in it")
    cases = [Case(x, height, seconds, solver) for x in positions for height in heights]
    for case in cases:
        _check(case)
    with preparing():
        ensure_compiled(needs(scene_of(cases[0])))
    with ResultFolder(out) as folder, _executor(executor, workers, len(cases)) as pool:
        outcomes = _run_all(pool, cases, progress)
        _write_csv(folder.path / "study.csv", outcomes)
        plot_study(folder.path / "study.png", outcomes, f"{scene}: water that passes the wall")
    return outcomes


def _check(case: Case):
    low, high = BEGIN
    if not low <= case.position <= high:
        raise StudyError(
            f"--positions: expected {low:g} to {high:g} m (between the water and the house), got "
            f"{case.position:g}"
        )
    if not 0.1 <= case.height <= 2.9:
        raise StudyError(f"--heights: expected 0.1 to 2.9 m, got {case.height:g}")


@contextmanager
def _executor(executor, workers, count):
    """The executor given, or processes that each compute on one core."""
    if executor is not None:
        yield executor
        return
    workers = min(workers or len(os.sched_getaffinity(0)), count)
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = "1"  # children read it when they import numba
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_ignore_ctrl_c
    )
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def _ignore_ctrl_c():
    """A terminal sends Ctrl-C to all; only the parent heeds it, and then ends its children."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run_all(pool, cases, progress):
    """Outcomes in the order of the cases, with a progress bar."""
    futures = {pool.submit(run_case, case): index for index, case in enumerate(cases)}
    outcomes = [None] * len(cases)
    try:
        for future in progress(as_completed(futures), total=len(cases), unit="run", disable=None):
            outcomes[futures[future]] = future.result()
    except BrokenProcessPool:
        raise StudyError("a process of the study died; was there enough memory?") from None
    return outcomes


def _write_csv(path, outcomes):
    """One line for each run."""
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(field.name for field in dataclasses.fields(Outcome))
        writer.writerows(dataclasses.astuple(outcome) for outcome in outcomes)


def report(outcomes: list[Outcome]) -> str:
    """Table and answer for people."""
    return f"{table(outcomes)}\n{answer(outcomes)}"
