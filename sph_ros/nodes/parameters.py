# SPDX-License-Identifier: Apache-2.0
"""Parameters of the fluid node: declared once, described, ranged; checked first, applied later."""

import math
import re

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.parameter import Parameter

from sph_ros.sim.materials import RANGES, Material, changed
from sph_ros.sim.scene import SceneError

STEP_MODES = ("realtime", "clock", "lockstep")

MATERIAL_PREFIX = "material."

#: How far simulated time may lag before the lag is forgotten, by step mode [s]. A /clock may tick
#: slowly, and each tick then asks for all of its time at once.
DEFAULT_CATCH_UP = {"realtime": 0.1, "clock": 1.0, "lockstep": 0.1}

MATERIAL_TEXTS = {
    "density": "rest density [kg/m^3]",
    "viscosity": "dynamic viscosity [Pa s]",
    "surface_tension": "surface tension against air [N/m]",
    "compression": "relative compression allowed at the deepest point at rest [-]",
    "wall_friction": "0 lets the liquid slip along solids, 1 drags it with them [-]",
    "adhesion": "how strongly solids hold the liquid, as a share of its own cohesion [-]",
    "quadratic_viscosity": "damps pairs that collide fast (Clavet's beta times the spacing) [-]",
    "elasticity": "shear modulus of springs between neighbours; 0: a liquid [Pa]",
    "yield_strain": "relative deformation that springs spring back from [-]",
    "plasticity": "rate at which springs give way beyond that [1/s]",
    "gyration_radius": "flywheels that let vortices up to this radius live longer; 0: none [m]",
}


class ParameterError(ValueError):
    """A parameter cannot be used; one line that says why."""


class Settings:
    """The parameters of a fluid node.

    `declare_first` first: the scene that it names has the defaults of the live ones.

    Args:
        node: that gets the parameters.
    """

    def __init__(self, node):
        self._node = node
        self._apply = self._prepare = None

    def declare_first(self):
        """Declare what all others depend on; returns (scene, step_mode)."""
        scene = self._declare(
            "scene",
            "ball_tank",
            "scene: packaged name or path of a YAML file; another one starts over with its own "
            "material",
        )
        step_mode = self._declare(
            "step_mode",
            "realtime",
            "what drives simulated time: realtime (this machine's clock), clock (the ROS clock, "
            "/clock with use_sim_time), lockstep (every pose message: one publication period)",
            read_only=True,
            additional_constraints=f"one of {', '.join(STEP_MODES)}",
        )
        if step_mode not in STEP_MODES:
            raise ParameterError(
                f"parameter step_mode: expected one of {', '.join(STEP_MODES)}, got {step_mode!r}"
            )
        return scene, step_mode

    def declare_live(self, material, step_mode):
        """Declare what may change while the node runs; defaults from the scene's material."""
        number = self._declare_number
        number("publish_rate", 30.0, 0.1, 1000.0, "publications per second [Hz]; see step_mode")
        number("surface_rate", 24.0, 0.1, 1000.0, "surfaces per second, at most [Hz]")
        number("speed", 1.0, 0.01, 100.0, "simulated per real time, in realtime mode [-]")
        number(
            "max_catch_up",
            DEFAULT_CATCH_UP[step_mode],
            0.0,
            60.0,
            "simulated time may lag so far behind before the lag is forgotten [s]",
        )
        number(
            "smoothing_time",
            0.05,
            0.0,
            1.0,
            "a solid reaches a new pose when the next one may be expected, late ones included, but "
            "after so long at most [s]; 0: within one time step",
        )
        for field, (low, high) in RANGES.items():
            text = MATERIAL_TEXTS.get(field, field.replace("_", " "))
            number(MATERIAL_PREFIX + field, getattr(material, field), low, high, text)

    def follow(self, apply, prepare):
        """From now on check every change, and put those to use that were accepted.

        Args:
            apply: called with the names of changed parameters after each change.
            prepare: called with a scene's name before it is accepted; raises SceneError.
        """
        self._apply, self._prepare = apply, prepare
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._applied)

    def __getitem__(self, name):
        """Present value of a parameter."""
        return self._node.get_parameter(name).value

    def material(self):
        """Present values of all fields of the material."""
        return {field: within_range(field, self[MATERIAL_PREFIX + field]) for field in RANGES}

    def set_material(self, material, keep=()):
        """Give all fields the values of a Material, as if somebody had set them, except `keep`."""
        self._node.set_parameters_atomically(
            [
                Parameter(MATERIAL_PREFIX + field, value=float(getattr(material, field)))
                for field in RANGES
                if MATERIAL_PREFIX + field not in keep
            ]
        )

    def _declare_number(self, name, default, low, high, text):
        value = self._declare(
            name,
            float(default),
            text,
            floating_point_range=[FloatingPointRange(from_value=float(low), to_value=float(high))],
        )
        if not math.isfinite(value):
            raise ParameterError(f"parameter {name}: expected {low:g} to {high:g}, got {value}")

    def _declare(self, name, default, description, **descriptor):
        descriptor = ParameterDescriptor(name=name, description=description, **descriptor)
        try:
            return self._node.declare_parameter(name, default, descriptor).value
        except InvalidParameterTypeException as error:
            raise ParameterError(
                f"parameter {name}: expected {_type_name(default)}, {error}"
            ) from error
        except InvalidParameterValueException as error:
            raise ParameterError(f"parameter {name}: {_refusal(descriptor, error)}") from error

    def _check(self, parameters):
        """Refuse a material or scene that cannot be; rclpy has checked types and ranges."""
        values = self.material()
        for parameter in parameters:
            field = parameter.name.removeprefix(MATERIAL_PREFIX)
            if parameter.name.startswith(MATERIAL_PREFIX) and field in values:
                values[field] = within_range(field, parameter.value)
        try:
            changed(Material(), **values)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=f"{MATERIAL_PREFIX}{error}")
        try:
            for parameter in parameters:
                if parameter.name == "scene":
                    self._prepare(parameter.value)
        except Exception as error:  # a scene that breaks something must not end the node
            kind = "" if isinstance(error, SceneError) else f"{type(error).__name__}: "
            return SetParametersResult(successful=False, reason=f"{kind}{_one_line(error)}")
        return SetParametersResult(successful=True)

    def _applied(self, parameters):
        self._apply([parameter.name for parameter in parameters])


def declare_all(node):
    """Declare every parameter, with the defaults of water: for those who want to know of them."""
    settings = Settings(node)
    _, step_mode = settings.declare_first()
    settings.declare_live(Material(), step_mode)


def within_range(field, value):
    """The value; at a bound where rclpy's tolerance let it slip over by a rounding error."""
    low, high = RANGES[field]
    for bound in (low, high):
        if math.isclose(value, bound, rel_tol=1e-6):
            return bound
    return value


def _refusal(descriptor, error):
    """What was expected and given; rclpy tells the value only within its sentence."""
    given = re.search(r"Invalid parameter value \((.*?)\)", str(error))
    if not (given and descriptor.floating_point_range):
        return str(error)
    limit = descriptor.floating_point_range[0]
    return f"expected {limit.from_value:g} to {limit.to_value:g}, got {given[1]}"


def _one_line(error):
    return " ".join(str(error).split())


def _type_name(value):
    return "a number with a decimal point" if isinstance(value, float) else "text"
