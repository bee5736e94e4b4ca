# SPDX-License-Identifier: Apache-2.0
"""Free bodies in the pressure iterations of a solver."""

import numpy as np

from sph_ros.core import coupling

#: Passes over the touches of bodies in one pressure iteration; they start from the last one's.
PASSES = 20


class Coupling:
    """The free bodies among a liquid's contacts in one step.

    A solver's unknowns are pressures p of the particles. Particle i is moved by the walls by
    -p_i G_i, in whatever unit (displacement, velocity) the solver uses; `motion_scale` turns a
    velocity [m/s] into that unit and `impulse_scale` turns p G into an impulse [N s]. With it:

        coupling.add_diagonal(diagonal)      once
        coupling.respond(pressures)          in each iteration, then subtract `yielded[i]` from
                                             the growth of particle i's density
    """

    def __init__(self, bodies, contacts, positions, centres, impulse_scale, motion_scale, yielded):
        """Collect the contacts with free bodies.

        Args:
            bodies: `Bodies`, between begin() and finish().
            contacts: `Contacts`.
            positions: of the particles where the contacts were found [m], (N, 3).
            centres: of mass where the contacts were found [m], (B, 3).
            impulse_scale, motion_scale: see above.
            yielded: how much the density sinks because bodies give way, (N,) float32; kept up to
                date by `respond`.
        """
        self._bodies = bodies
        self._contacts = contacts
        self._impulse_scale, self._motion_scale = impulse_scale, motion_scale
        self.yielded = yielded
        self.yielded[:] = 0.0
        self.wetted = coupling.wetted_contacts(positions, contacts, bodies.body_of, centres)

    def add_diagonal(self, diagonal):
        """Add what bodies that give way mean for the diagonal, (N,) float32."""
        scale = self._impulse_scale * self._motion_scale
        coupling.add_body_diagonal(self.wetted, self._bodies.roots(), scale, diagonal)

    def respond(self, pressures):
        """Let the bodies give way to pressures (N,); writes `yielded`."""
        bodies = self._bodies
        velocities = np.empty_like(bodies.free)
        coupling.give_way(
            self.wetted,
            pressures,
            self._impulse_scale,
            bodies.free,
            bodies.inertias,
            bodies.touches,
            bodies.touch_count,
            bodies.tolerance,
            PASSES,
            velocities,
        )
        motion = self._motion_scale * (velocities - bodies.predicted)
        coupling.yielded_density(self.wetted, motion, self.yielded)

    def drag_along(self, velocities, rate, drag, mass):
        """Prepare friction: the bodies' surfaces move as they will once the liquid has rubbed.

        Args:
            velocities: of the particles [m/s], (N, 3).
            rate, drag: as in `rub_on_solids`.
            mass: of a particle [kg].
        """
        bodies = self._bodies
        coupling.move_surfaces(self.wetted, bodies.velocities_now(), self._contacts)
        matrix = bodies.mass_matrices()
        right = np.einsum("bij,bj->bi", matrix, bodies.velocities_now())
        coupling.friction_system(
            self.wetted, self._contacts, velocities, rate, drag, mass, matrix, right
        )
        coupling.move_surfaces(self.wetted, bodies.solve(matrix, right), self._contacts)

    def predict(self):
        """Let the bodies' surfaces move as they would without pressure."""
        coupling.move_surfaces(self.wetted, self._bodies.predicted, self._contacts)
