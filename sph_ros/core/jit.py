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
from pathlib import Path

from numba import cfunc, config, njit

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


def compiler(**options):
    """A decorator like njit with our policy, whose kernels are cached in our folder."""
    return _kept(njit(fastmath=FASTMATH, cache=True, error_model="numpy", **options))


def callback(signature):
    """A decorator for what other code calls by its address, with one signature."""
    if config.DISABLE_JIT:
        return lambda function: function
    return _kept(cfunc(signature, cache=True, error_model="numpy"))


def _kept(decorator):
    """The same decorator, with its cache in our folder."""

    def decorate(function):
        before, config.CACHE_DIR = config.CACHE_DIR, KERNELS
        try:
            return decorator(function)
        finally:
            config.CACHE_DIR = before

    return decorate


#: Folder of the compiled kernels of these sources in this place.
KERNELS = _cache_folder()

#: A small function, meant to be inlined into the kernels that call it; may make and return arrays.
device = compiler()

#: A function that reads and writes arrays, or tuples of many of them, but neither makes nor returns
#: any, and is always part of its caller's code. References are not counted in it, which else takes
#: longer than the distance to a solid, and lets threads wait for each other. A function that
#: returned an array would corrupt memory.
inlined = compiler(forceinline=True, _nrt=False)

#: The same as a function of its own: for what is long, or called from many places.
called = compiler(_nrt=False)

#: A loop over arrays on one thread; the GIL is released.
kernel = compiler(nogil=True)

#: The same without counted references, see `inlined`: a third to a half of the time where a loop
#: calls functions with many arrays.
bare_kernel = compiler(nogil=True, _nrt=False)
