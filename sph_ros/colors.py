# SPDX-License-Identifier: Apache-2.0
"""What colour things have wherever they are drawn: pictures, browser, markers. sRGB, 0 to 1."""

import numpy as np

from sph_ros.sim.shapes import Container

#: Red, green, blue, alpha.
LIQUID = (0.20, 0.45, 0.75, 0.8)
CONTAINER = (0.70, 0.70, 0.70, 0.15)
GLASS = (0.75, 0.85, 0.85, 0.25)

#: Of solids for which the scene gives none, in turn: red, green, blue.
SOLIDS = ((0.90, 0.48, 0.32), (0.93, 0.76, 0.32), (0.48, 0.69, 0.38), (0.62, 0.46, 0.73))

# Where the sun is, how dark the dark side is, how strong and how small the gleam is.
_SUN = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
_LEAST_LIGHT, _BRIGHTNESS, _GLEAM, _GLOSS = 0.35, 1.15, 0.55, 24.0

# Deep blue at rest, over light blue to white foam: share of the highest speed, red, green, blue.
_SPEED_STOPS = np.array(
    [
        (0.00, 0.08, 0.24, 0.55),
        (0.35, 0.16, 0.51, 0.84),
        (0.70, 0.55, 0.80, 0.94),
        (1.00, 0.98, 0.99, 1.00),
    ]
)


def liquid_color(material):
    """Red, green, blue, alpha of a liquid where it is drawn as a plain surface."""
    return LIQUID if material.color is None else (*material.color, 1.0)


def solid_colors(scene):
    """Red, green, blue, alpha of every solid of a scene by name: the scene's, or one of ours."""
    colors, chosen = {}, 0
    for solid in scene.solids:
        if isinstance(solid.shape, Container):
            colors[solid.name] = CONTAINER
        elif solid.color is not None:
            colors[solid.name] = (*solid.color, GLASS[3] if solid.see_through else 1.0)
        elif solid.see_through:
            colors[solid.name] = GLASS
        else:
            colors[solid.name] = (*SOLIDS[chosen % len(SOLIDS)], 1.0)
            chosen += 1
    return colors


def speed_colors(shares):
    """Red, green, blue (N, 3) of speeds as shares of the highest, (N,).

    Values outside 0 to 1 are clipped, NaN is 0.
    """
    shares = np.clip(np.nan_to_num(np.asarray(shares, float), posinf=1.0, neginf=0.0), 0.0, 1.0)
    at, stops = _SPEED_STOPS[:, 0], _SPEED_STOPS[:, 1:]
    return np.stack([np.interp(shares, at, stops[:, c]) for c in range(3)], axis=1)


def shaded_liquid(normals, color=LIQUID[:3]):
    """The liquid's colour lit from above, for viewers that cannot shade smoothly by themselves.

    Args:
        normals: unit outward normals, (V, 3), z up.
        color: red, green, blue of the liquid, (3,) or of each vertex (V, 3).

    Returns:
        red, green, blue, alpha (V, 4) float32: light from the sky and a soft gleam of the sun.
    """
    toward_sun = normals @ _SUN
    light = _LEAST_LIGHT + (1.0 - _LEAST_LIGHT) * (0.5 + 0.5 * toward_sun)
    gleam = _GLEAM * np.maximum(toward_sun, 0.0) ** _GLOSS
    colors = np.ones((len(normals), 4), np.float32)
    colors[:, :3] = light[:, None] * np.array(color) * _BRIGHTNESS
    colors[:, :3] += gleam[:, None] * (1.0 - colors[:, :3])
    return np.minimum(colors, 1.0)


def linear(rgb):
    """Amounts of light of sRGB colours, with the usual power of 2.2."""
    return np.asarray(rgb, float) ** 2.2
