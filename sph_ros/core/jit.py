# SPDX-License-Identifier: Apache-2.0
"""How every compiled function of the project is compiled.

One floating-point policy for all: sums may be re-associated and multiplications fused, so that
loops vectorise, but NaN and infinity keep their meaning (a NaN must stay visible) and no
approximate reciprocal is taken, because a vector body and its scalar remainder would then round
differently and the result would depend on how the loop was split among threads. (The vectors of
`core.vector` have no remainder, so its `inverse_root` may start from the processor's estimate.)
"""

import hashlib
import os
import shutil
from contextlib import contextmanager
from pathlib import Path

# A thread that waits for the others spins for some microseconds, then sleeps. Sleeping at once
# costs a step of 5,000 particles half its speed in wake-ups; spinning on takes the processor from
# the very thread it waits for as soon as other programs run too, and a step then takes ten times as
# long: with twice as many turns two nodes that never wait do two thirds as much together. Read by
# libgomp when it is loaded, at the first parallel call.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from numba import config, get_num_threads, njit, set_num_threads  # noqa: E402

FASTMATH = {"reassoc", "contract", "nsz"}

#: Versions of this package whose compiled kernels are kept.
KEPT_VERSIONS = 8


def _cache_folder():
    """Where compiled kernels are kept: a folder that belongs to exactly these sources.

    Numba looks only at the file of the cached function itself; a change in a function that it calls
    from another file would go unnoticed. So all sources with kernels name the folder. Those of the
    last few versions stay, because other processes may be running them.
    """
    package = Path(__file__).parents[1]
    sources = sorted([*package.glob("core/*.py"), *package.glob("render/*.py")])
    texts = [str(package).encode(), *(path.read_bytes() for path in sources)]
    digest = hashlib.sha256(b"".join(texts)).hexdigest()
    base = config.CACHE_DIR or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    kernels = Path(base) / "sph_ros" / "kernels"
    folder = kernels / digest[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        folders = sorted(kernels.iterdir(), key=lambda path: path.stat().st_mtime)
        for old in folders[:-KEPT_VERSIONS]:
            if old != folder:
                shutil.rmtree(old, ignore_errors=True)
    except OSError:
        pass  # numba then finds a place of its own, or none
    return str(folder)


def _compiler(**options):
    """A decorator like njit with our policy, whose kernels are cached in our folder."""

    def decorate(function):
        before, config.CACHE_DIR = config.CACHE_DIR, KERNELS
        try:
            return njit(fastmath=FASTMATH, cache=True, error_model="numpy", **options)(function)
        finally:
            config.CACHE_DIR = before

    return decorate


@contextmanager
def one_thread():
    """Kernels called within run on the calling thread alone.

    Each thread that calls parallel kernels gets helpers of its own, which then live as long as it
    does. Once there are more helpers in a process than processors, libgomp's threads no longer spin
    but sleep when they wait for each other, and steps take a quarter longer. So only one thread of
    a process should have any.
    """
    before = get_num_threads()
    set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(before)


#: Folder of the compiled kernels of these sources in this place.
KERNELS = _cache_folder()

#: A small function, meant to be inlined into the kernels that call it; may make and return arrays.
device = _compiler()

#: A function that reads and writes arrays, or tuples of many of them, but neither makes nor returns
#: any, and is always part of its caller's code. References are not counted in it, which else takes
#: longer than the distance to a solid, and lets threads wait for each other. A function that
#: returned an array would corrupt memory.
inlined = _compiler(forceinline=True, _nrt=False)

#: The same as a function of its own: for what is long, or called from many places.
called = _compiler(_nrt=False)

#: A loop over arrays on one thread; the GIL is released.
kernel = _compiler(nogil=True)

#: The same without counted references, see `inlined`: a third to a half of the time where a loop
#: calls functions with many arrays.
bare_kernel = _compiler(nogil=True, _nrt=False)

#: What numba makes parallel: loops that say so, and nothing else. It need not look for more.
LOOPS = {
    "prange": True,
    **dict.fromkeys(("comprehension", "reduction", "inplace_binop", "setitem", "numpy"), False),
    **dict.fromkeys(("stencil", "fusion"), False),
}

#: A loop over arrays spread over threads. Iteration i of `prange` may write row i only. Give arrays
#: that are fields of a tuple a local name before the loop: numba loses direct writes to them inside
#: `prange`. What takes long in every step is shared out by `core.chunks`.
parallel_kernel = _compiler(nogil=True, parallel=LOOPS)
