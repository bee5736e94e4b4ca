# SPDX-License-Identifier: Apache-2.0
"""Threads that share out parallel loops: all is done once, whoever comes or sleeps."""

import os
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import numba
import numpy as np
from numba import prange

from sph_ros.core.team import parallel_kernel


@parallel_kernel
def count_visits(visits, rounds):
    """Visit each row so often, in a loop of its own each time."""
    for _ in range(rounds):
        for i in prange(visits.shape[0]):
            visits[i] += 1


@parallel_kernel
def chain(rows, rounds):
    """Each loop needs all that the one before it has written."""
    count = rows.shape[1]
    for k in range(rounds):
        old, new = rows[k % 2], rows[(k + 1) % 2]
        for i in prange(count):
            new[i] = 0.5 * (old[i - 1] + old[(i + 1) % count])


@parallel_kernel
def sums(rounds, count):
    """Sums of 0 ... count - 1 and of its squares, in loops of their own each time."""
    first, second = 0, 0
    squares = np.arange(count) ** 2
    for _ in range(rounds):
        for i in prange(count):
            first += i
        second += squares.sum()
    return first, second


def run(code, **environment):
    """Standard output of a Python process."""
    inherited = {k: v for k, v in os.environ.items() if k != "NUMBA_THREADING_LAYER"}
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**inherited, "PYTHONPATH": str(Path(__file__).parent), **environment},
        capture_output=True,
        text=True,
        check=True,
        timeout=120.0,
    ).stdout


def test_every_part_is_done_once_and_before_the_next_loop_begins():
    visits = np.zeros(1003, np.int64)
    count_visits(visits, 20_000)
    np.testing.assert_array_equal(visits, 20_000)
    rows = np.zeros((2, 97))
    rows[0] = expected = np.random.default_rng(1).random(97)
    chain(rows, 3000)
    for _ in range(3000):
        expected = 0.5 * (np.roll(expected, 1) + np.roll(expected, -1))
    np.testing.assert_allclose(rows[0], expected, rtol=1e-12)


def test_sums_lose_nothing():
    # A sum is kept per thread: two that took themselves for the same one lost some in a hundred.
    first, second = sums(20_000, 50)
    assert (first, second) == (20_000 * 1225, 20_000 * 40425)


def test_loops_of_several_threads_at_once_are_all_done():
    tables = [np.zeros(513, np.int64) for _ in range(6)]
    threads = [threading.Thread(target=count_visits, args=(t, 4000)) for t in tables]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    for table in tables:
        np.testing.assert_array_equal(table, 4000)


def test_helpers_that_have_gone_to_sleep_come_back():
    # In a process with a helper, however many processors there are.
    told = run(
        """
        import time
        import numpy as np
        from test_team import count_visits
        from sph_ros.core.atomics import words
        from sph_ros.core import team
        def waited_for(state, meanwhile):
            deadline = time.monotonic() + 10.0
            while words[team.FIRST_HELPER] != state and time.monotonic() < deadline:
                meanwhile()
            return words[team.FIRST_HELPER] == state
        visits = np.zeros(100, np.int64)
        count_visits(visits, 10)
        for _ in range(20):
            assert waited_for(1, lambda: time.sleep(0.001)), "without work it does not sleep"
            assert waited_for(0, lambda: count_visits(visits, 10)), "nobody wakes it"
        print(words[team.HELPERS], np.unique(visits).size)
        """,
        NUMBA_NUM_THREADS="2",
    )
    assert told.split() == ["1", "1"]


def test_one_thread_and_a_forked_process_do_all_alone():
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        visits = np.zeros(333, np.int64)
        count_visits(visits, 100)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(visits, 100)
    told = run(
        """
        import os, numpy as np
        from test_team import count_visits
        from sph_ros.core.atomics import words
        from sph_ros.core import team
        visits = np.zeros(333, np.int64)
        count_visits(visits, 100)
        child = os.fork()
        if child == 0:
            count_visits(visits, 100)
            good = (visits == 200).all() and words[team.HELPERS] == 0
            os._exit(0 if good else 1)
        print(os.waitpid(child, 0)[1])
        """,
        NUMBA_NUM_THREADS="2",
    )
    assert told.split() == ["0"]


def test_a_process_ends_while_its_helpers_wait_or_sleep():
    for pause in (0.0, 0.05):
        run(
            f"""
            import time, numpy as np
            from test_team import count_visits
            count_visits(np.zeros(333, np.int64), 100)
            time.sleep({pause})
            """
        )


def test_more_threads_than_processors_and_parts_than_threads():
    told = run(
        """
        import numba, numpy as np
        from test_team import count_visits, sums
        from sph_ros.core.atomics import words
        from sph_ros.core import team
        for size in (0, 3):
            numba.set_parallel_chunksize(size)
            visits = np.zeros(333, np.int64)
            count_visits(visits, 300)
            print(words[team.HELPERS], (visits == 300).all(), *sums(300, 50))
            numba.set_num_threads(3)
        """,
        NUMBA_NUM_THREADS="8",
    )
    assert told.splitlines() == 2 * [f"7 True {300 * 1225} {300 * 40425}"]


def test_a_layer_of_numba_is_kept_when_it_is_asked_for():
    told = run(
        """
        import numpy as np
        from test_team import count_visits
        from sph_ros.core.atomics import words
        from sph_ros.core import team
        visits = np.zeros(333, np.int64)
        count_visits(visits, 100)
        print(words[team.HELPERS], (visits == 100).all())
        """,
        NUMBA_THREADING_LAYER="workqueue",
    )
    assert told.split() == ["0", "True"]
