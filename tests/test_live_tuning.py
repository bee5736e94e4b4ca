# SPDX-License-Identifier: Apache-2.0
"""Every packaged scene is tuned through ROS parameters while it runs."""

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from ros_helpers import RosSession
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from msg_adapters.point_cloud import cdr_to_particle_cloud
from sph_ros.sim.scene import list_scenes


class Tuner:
    """A paused fluid_node that steps when it is told to."""

    def __init__(self, ros):
        self._ros = ros
        self.clouds = ros.collect(PointCloud2, "/fluid/particles", raw=True)
        ros.start("sph_ros.nodes.fluid_node", "--ros-args", "-p", "scene:=jelly")
        publishers = ros.node.get_publishers_info_by_topic
        ros.wait_for(lambda: publishers("/fluid/particles"), 90.0, "for fluid_node")
        assert ros.call(SetBool, "/fluid/pause", SetBool.Request(data=True)).success

    def set(self, name, value):
        """Set a parameter; AssertionError with the reason when it is refused."""
        kind = "string" if isinstance(value, str) else "double"
        type_ = getattr(ParameterType, f"PARAMETER_{kind.upper()}")
        value = ParameterValue(type=type_, **{f"{kind}_value": value})
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        result = self._ros.call(SetParameters, "/fluid/set_parameters", request, 60.0).results[0]
        assert result.successful, result.reason

    def number(self, name):
        """Value of a parameter."""
        request = GetParameters.Request(names=[name])
        values = self._ros.call(GetParameters, "/fluid/get_parameters", request).values
        return values[0].double_value

    def step(self):
        """Densities by id after one more step."""
        before = len(self.clouds)
        assert self._ros.call(Trigger, "/fluid/step", Trigger.Request()).success
        self._ros.wait_for(lambda: len(self.clouds) > before, what="for particles")
        cloud = cdr_to_particle_cloud(self.clouds[-1])
        return dict(zip(cloud.ids.tolist(), cloud.densities.tolist(), strict=True))


@pytest.fixture(scope="module")
def tuner():
    with RosSession("tuner") as ros:
        yield Tuner(ros)


@pytest.mark.parametrize("scene", list_scenes())
def test_density_follows_its_parameter(tuner, scene):
    tuner.set("scene", scene)
    tuner.step()  # the cloud that answers may be of the scene before
    before = tuner.step()
    while len(before) < 2:  # where all liquid comes from emitters
        before = tuner.step()
    density = tuner.number("material.density")
    tuner.set("material.density", 0.5 * density)
    for _ in range(4):  # a cloud of before may still be on its way
        after = tuner.step()
        ratios = np.array([after[k] / before[k] for k in before.keys() & after.keys()])
        halved = ratios[ratios < 0.75]
        # Other liquids in the scene, half of the particles at most, keep theirs.
        if len(halved) > 0.45 * len(ratios):
            break
    assert len(halved) > 0.45 * len(ratios)
    assert np.median(halved) == pytest.approx(0.5, rel=0.1)
    tuner.set("material.gyration_radius", 0.02)
    for name in ("viscosity", "surface_tension", "elasticity", "gyration_radius"):
        tuner.set(f"material.{name}", 0.5 * tuner.number(f"material.{name}"))
    assert tuner.step()
