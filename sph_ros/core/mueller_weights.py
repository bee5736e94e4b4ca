# SPDX-License-Identifier: Apache-2.0
"""The weights of Mueller, Charypar & Gross 2003 in two and three dimensions.

Poly6 for densities and colour, spiky for pressure (its slope does not vanish where particles meet),
and one whose Laplacian is h - r, never negative, for viscosity:

    poly6       A (h^2 - r^2)^3                 eq. 20
    spiky       A (h - r)^3                     eq. 21
    viscosity   Laplacian A (h - r)             eq. 22

The constants A make the integral over the ball (2D: the disc) of radius h equal to 1. The paper
gives those of 3D; in 2D the viscosity weight has a logarithm in place of 1/r. All functions take
0 <= r <= h (`viscosity` r > 0) of any shape, in metres.
"""

import math

import numpy as np

_PI = math.pi


def poly6_scale(h, dimension):
    """Constant A of poly6 [1/m^(6 + d)]."""
    return 315.0 / (64.0 * _PI * h**9) if dimension == 3 else 4.0 / (_PI * h**8)


def spiky_scale(h, dimension):
    """Constant A of spiky [1/m^(3 + d)]."""
    return 15.0 / (_PI * h**6) if dimension == 3 else 10.0 / (_PI * h**5)


def viscosity_scale(h, dimension):
    """Constant A of the viscosity weight's Laplacian [1/m^(3 + d)]."""
    return 45.0 / (_PI * h**6) if dimension == 3 else 40.0 / (_PI * h**5)


def poly6(r, h, dimension):
    """Poly6 [1/m^d]."""
    return poly6_scale(h, dimension) * (h * h - np.square(r)) ** 3


def poly6_slope(r, h, dimension):
    """Derivative of poly6 by r [1/m^(d + 1)]."""
    return -6.0 * poly6_scale(h, dimension) * r * (h * h - np.square(r)) ** 2


def poly6_laplacian(r, h, dimension):
    """Laplacian of poly6 [1/m^(d + 2)]."""
    square = np.square(r)
    curved = dimension * (h * h - square) - 4.0 * square
    return -6.0 * poly6_scale(h, dimension) * (h * h - square) * curved


def spiky(r, h, dimension):
    """Spiky [1/m^d]."""
    return spiky_scale(h, dimension) * (h - np.asarray(r)) ** 3


def spiky_slope(r, h, dimension):
    """Derivative of spiky by r [1/m^(d + 1)]."""
    return -3.0 * spiky_scale(h, dimension) * (h - np.asarray(r)) ** 2


def viscosity(r, h, dimension):
    """The viscosity weight [1/m^d]; r > 0."""
    r = np.asarray(r, dtype=float)
    scale = viscosity_scale(h, dimension)
    if dimension == 3:
        return scale * h**3 / 6.0 * (-(r**3) / (2.0 * h**3) + (r / h) ** 2 + h / (2.0 * r) - 1.0)
    return scale * (h * r * r / 4.0 - r**3 / 9.0 - h**3 / 6.0 * np.log(r / h) - 5.0 * h**3 / 36.0)


def viscosity_laplacian(r, h, dimension):
    """Laplacian of the viscosity weight [1/m^(d + 2)]."""
    return viscosity_scale(h, dimension) * (h - np.asarray(r))
