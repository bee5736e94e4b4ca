# SPDX-License-Identifier: Apache-2.0
"""How every compiled function of the project is compiled.

One floating-point policy for all: sums may be re-associated and multiplications fused, so that
loops vectorise, but NaN and infinity keep their meaning (a NaN must stay visible) and no
approximate reciprocal is taken, because a vector body and its scalar remainder would then round
differently and the result would depend on how the loop was split among threads.
"""

import hashlib
import os
from pathlib import Path

# Threads that wait must sleep. A waiting thread that spins takes the processor from the very thread
# it waits for as soon as other programs run too, and a step then takes ten times as long. Read by
# libgomp when it is loaded, at the first parallel call.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from numba import njit  # noqa: E402


def _drop_stale_kernels():
    """Delete cached kernels when any source beside this file has changed.

    Numba looks only at the file of the cached function itself; a change in a function that it calls
    from another file would go unnoticed.
    """
    folder = Path(__file__).parent
    sources = sorted(folder.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    mark = folder / "__pycache__" / "kernels.sha256"
    try:
        if mark.exists() and mark.read_text() == digest:
            return
        mark.parent.mkdir(exist_ok=True)
        for pattern in ("*.nbi", "*.nbc"):
            for stale in mark.parent.glob(pattern):
                stale.unlink(missing_ok=True)
        mark.write_text(digest)
    except OSError:
        return  # A folder that cannot be written holds no cache of ours.


_drop_stale_kernels()

FASTMATH = {"reassoc", "contract", "nsz"}

#: A small scalar function, meant to be inlined into the kernels that call it.
device = njit(fastmath=FASTMATH, cache=True, error_model="numpy")

#: The same, always part of its caller's code: handing tuples of many arrays to a function that is
#: really called counts references, which takes longer than the distance to a solid.
inlined = njit(fastmath=FASTMATH, cache=True, error_model="numpy", forceinline=True)

#: A loop over arrays on one thread; the GIL is released.
kernel = njit(fastmath=FASTMATH, cache=True, error_model="numpy", nogil=True)

#: A loop over arrays spread over threads. Iteration i of `prange` may write row i only. Give arrays
#: that are fields of a tuple a local name before the loop: numba loses direct writes to them inside
#: `prange`.
parallel_kernel = njit(
    fastmath=FASTMATH, cache=True, error_model="numpy", nogil=True, parallel=True
)
