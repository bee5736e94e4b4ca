# SPDX-License-Identifier: Apache-2.0
"""A calibrated lens as compiled code uses it: points to pixels, and pixels to rays.

The model is OpenCV's (documentation of its module calib3d): with x = X/Z, y = Y/Z, r^2 = x^2 + y^2

    x' = x R + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
    y' = y R + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4
    R  = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)

followed by a homography: the camera matrix, times the tilt of the sensor if there is one.
"""

import numpy as np

from sph_ros.core.jit import bare_kernel, inlined


class Lens:
    """A lens and the tables that are made from it once.

    Pixels are counted from the centre of the first one, as in OpenCV and ROS.

    Args:
        camera: CameraModel; its width and height must be known.

    Attributes:
        size: (width, height) [pixels].
        packed: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, the homography row by row, and the square of
            the radius where the model ends: 22 numbers for `lens_point`.
    """

    def __init__(self, camera):
        self.size = int(camera.width), int(camera.height)
        if min(self.size) < 1:
            raise ValueError(f"camera: {self.size} pixels, expected its width and height")
        coefficients = np.zeros(14)
        coefficients[: len(camera.distortion)] = camera.distortion
        homography = camera.matrix @ _tilt(*coefficients[12:])
        limit = _monotonic_radius(coefficients) ** 2
        # A tuple of numbers is what compiled functions hand on at no cost; arrays are counted.
        self.packed = (*map(float, coefficients[:12]), *map(float, homography.ravel()), limit)

    @property
    def focal(self):
        """Focal length, the mean of both [pixels]."""
        return 0.5 * (self.packed[12] + self.packed[16])

    def project(self, points):
        """Pixels (N, 2) float64 of points (N, 3) [m] in the camera's frame, all before it."""
        points = np.ascontiguousarray(points, np.float64)
        pixels = np.empty((len(points), 2))
        _project(points, self.packed, pixels)
        return pixels

    def rays(self, fine=1):
        """Ideal image coordinates X/Z, Y/Z of pixels, (fine height, fine width, 2) float32.

        Args:
            fine: samples along a pixel's edge.
        """
        width, height = self.size
        rays = np.empty((fine * height, fine * width, 2), np.float32)
        _rays(self.packed, fine, rays)
        return rays


def _tilt(x, y):
    """Homography of a sensor that is tilted by angles [rad] about x and y (OpenCV's matTilt)."""
    cx, sx, cy, sy = np.cos(x), np.sin(x), np.cos(y), np.sin(y)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    turn = about_y @ about_x
    back = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return back @ turn


def _monotonic_radius(coefficients):
    """Radius r = tan(angle to the axis) up to which points farther out have farther pixels.

    Beyond it the polynomial folds the world back into the picture, where it is not.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    r = np.linspace(0.0, 5.0, 2001)
    square = r * r
    below = 1.0 + square * (k4 + square * (k5 + square * k6))
    distorted = r * (1.0 + square * (k1 + square * (k2 + square * k3))) / below
    bad = np.flatnonzero((np.diff(distorted) <= 1e-6) | (below[1:] <= 0.0))
    return max(float(r[bad[0]] if len(bad) else r[-1]), 1e-3)


@inlined
def lens_point(x, y, lens):
    """Pixel of ideal image coordinates x = X/Z, y = Y/Z.

    Beyond the radius where the model is monotonic, points go on outwards in a straight line.
    """
    stretch = 1.0
    square = x * x + y * y
    if square > lens[21]:
        stretch = np.sqrt(square / lens[21])
        x, y, square = x / stretch, y / stretch, lens[21]
    radial = (1.0 + square * (lens[0] + square * (lens[1] + square * lens[4]))) / (
        1.0 + square * (lens[5] + square * (lens[6] + square * lens[7]))
    )
    a = x * radial + 2.0 * lens[2] * x * y + lens[3] * (square + 2.0 * x * x)
    b = y * radial + lens[2] * (square + 2.0 * y * y) + 2.0 * lens[3] * x * y
    a = (a + square * (lens[8] + square * lens[9])) * stretch
    b = (b + square * (lens[10] + square * lens[11])) * stretch
    w = 1.0 / (lens[18] * a + lens[19] * b + lens[20])
    return (
        (lens[12] * a + lens[13] * b + lens[14]) * w,
        (lens[15] * a + lens[16] * b + lens[17]) * w,
    )


@bare_kernel
def _project(points, lens, pixels):  # the last is written
    """Pixels (N, 2) of points (N, 3) before the camera."""
    for i in range(len(points)):
        scale = 1.0 / points[i, 2]
        pixels[i, 0], pixels[i, 1] = lens_point(points[i, 0] * scale, points[i, 1] * scale, lens)


@bare_kernel
def _rays(lens, fine, rays):  # the last is written
    """Ideal image coordinates of pixels, (fine height, fine width, 2), by Newton's method."""
    height, width, _ = rays.shape
    step = 1e-6
    for row in range(height):
        v = (row + 0.5) / fine - 0.5
        for column in range(width):
            u = (column + 0.5) / fine - 0.5
            if column == 0:  # the neighbour's is a good guess, the pinhole's a fair one
                x, y = (u - lens[14]) / lens[12], (v - lens[17]) / lens[16]
            for _ in range(30):
                a, b = lens_point(x, y, lens)
                ax, bx = lens_point(x + step, y, lens)
                ay, by = lens_point(x, y + step, lens)
                ax, bx, ay, by = (ax - a) / step, (bx - b) / step, (ay - a) / step, (by - b) / step
                ea, eb = u - a, v - b
                scale = 1.0 / (ax * by - ay * bx)
                x += scale * (by * ea - ay * eb)
                y += scale * (ax * eb - bx * ea)
                if ea * ea + eb * eb < 1e-6:
                    break
            rays[row, column, 0] = x
            rays[row, column, 1] = y
