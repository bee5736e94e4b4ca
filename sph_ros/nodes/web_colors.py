# SPDX-License-Identifier: Apache-2.0
"""Colours of speeds: deep blue at rest, over light blue to white foam."""

import numpy as np

#: Share of the highest value, red, green, blue.
_STOPS = np.array(
    [
        (0.00, 20, 60, 140),
        (0.35, 40, 130, 215),
        (0.70, 140, 205, 240),
        (1.00, 250, 252, 255),
    ]
)

_TABLE = np.stack(
    [np.interp(np.linspace(0.0, 1.0, 256), _STOPS[:, 0], _STOPS[:, c]) for c in (1, 2, 3)], axis=1
).astype(np.uint8)


def ramp(shares):
    """Colours (N, 3) uint8 of values 0 to 1, (N,); outside they are clipped, NaN is 0."""
    shares = np.nan_to_num(np.asarray(shares, np.float32), nan=0.0, posinf=1.0, neginf=0.0)
    return _TABLE[(np.clip(shares, 0.0, 1.0) * 255.0).astype(np.intp)]
