# SPDX-License-Identifier: Apache-2.0
"""Particles' colours in the browser: from speed, density or none, by tables of bytes. No rclpy."""

import numpy as np

from sph_ros.colors import LIQUID, speed_colors

COLORINGS = ("speed", "density", "none")

#: Share of the particles that are faster than the lightest colour.
FASTEST_SHARE = 0.02

#: The lightest colour is never slower than this [m/s]: liquid at rest does not flicker.
SLOWEST_SCALE = 0.05

#: A scale of speeds that is too large shrinks by this factor with every picture.
SCALE_DECAY = 0.98

#: Densities from rest are shown up to this share of it, below and above.
DENSITY_SPAN = 0.1

# Share of the span, red, green, blue: thin liquid is amber, at rest blue, squeezed violet.
_DENSITY_STOPS = np.array(
    [
        (0.00, 0.98, 0.80, 0.35),
        (0.35, 0.45, 0.78, 0.72),
        (0.50, 0.13, 0.45, 0.78),
        (0.75, 0.38, 0.22, 0.66),
        (1.00, 0.75, 0.10, 0.45),
    ]
)


def as_bytes(rgb):
    """Colours 0 to 1 as viser takes them."""
    return np.round(255.0 * np.asarray(rgb)).astype(np.uint8)


def _density_colors(shares):
    at, stops = _DENSITY_STOPS[:, 0], _DENSITY_STOPS[:, 1:]
    return np.stack([np.interp(shares, at, stops[:, c]) for c in range(3)], axis=1)


_SHARES = np.linspace(0.0, 1.0, 256)
#: Coloring -> colours of the shares 0 to 1 in 256 steps, (256, 3) uint8.
TABLES = {"speed": as_bytes(speed_colors(_SHARES)), "density": as_bytes(_density_colors(_SHARES))}
ONE_COLOR = as_bytes(LIQUID[:3])


class ParticleColors:
    """Colours of particles, and the scale they have.

    Attributes:
        rest_density: density [kg/m^3] in the middle of the scale of densities.
        legend: (lowest, highest, unit) of the scale in use; None without one.
    """

    def __init__(self):
        self.rest_density = 1000.0
        self.legend = None
        self._fastest = 0.0

    def of(self, coloring, velocities, densities):
        """Colours of N particles, (N, 3) uint8, or (3,) for all.

        Args:
            coloring: one of COLORINGS.
            velocities: [m/s], (N, 3).
            densities: [kg/m^3], (N,).
        """
        if coloring == "speed":
            shares = self._shares_of_speed(np.linalg.norm(velocities, axis=1))
        elif coloring == "density":
            shares = self._shares_of_density(densities)
        else:
            self.legend = None
            return ONE_COLOR
        # NaN comes out as zero.
        index = np.nan_to_num(255.0 * shares, posinf=255.0, neginf=0.0).clip(0.0, 255.0)
        return TABLES[coloring][index.astype(np.uint8)]

    def _shares_of_speed(self, speeds):
        rank = min(len(speeds) - 1, round((1.0 - FASTEST_SHARE) * len(speeds)))
        fast = float(np.nan_to_num(np.partition(speeds, rank)[rank], posinf=0.0))
        self._fastest = max(fast, SCALE_DECAY * self._fastest, SLOWEST_SCALE)
        self.legend = (0.0, self._fastest, "m/s")
        return speeds / np.float32(self._fastest)

    def _shares_of_density(self, densities):
        span = DENSITY_SPAN * self.rest_density
        low, high = self.rest_density - span, self.rest_density + span
        self.legend = (low, high, "kg/m³")
        return (densities - np.float32(low)) / np.float32(high - low)
