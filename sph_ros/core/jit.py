# SPDX-License-Identifier: Apache-2.0
"""How every compiled function of the project is compiled.

One floating-point policy for all: sums may be re-associated and multiplications fused, so that loops
vectorise, but NaN and infinity keep their meaning (a NaN must stay visible) and no approximate reciprocal is
taken, because a vector body and its scalar remainder would then round differently and the result
would depend on how the loop was split among threads.
"""

from numba import njit

FASTMATH = {"reassoc", "contract", "nsz"}

#: A small scalar function, meant to be inlined into the kernels that call it.
device = njit(fastmath=FASTMATH, cache=True, error_model="numpy")

#: A loop over arrays on one thread; the GIL is released.
kernel = njit(fastmath=FASTMATH, cache=True, error_model="numpy", nogil=True)

#: A loop over arrays spread over threads. Iteration i of `prange` may write row i only. Give arrays that
#: are fields of a tuple a local name before the loop: numba loses direct writes to them inside `prange`.
parallel_kernel = njit(
    fastmath=FASTMATH, cache=True, error_model="numpy", nogil=True, parallel=True
)
