# SPDX-License-Identifier: Apache-2.0
"""A fluid node as another node sees it: how it is, its parameters, its services."""

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool, Trigger

from sph_ros.nodes.parameters import MATERIAL_PREFIX
from sph_ros.nodes.web_controls import NumberInfo

#: The node reports once a second; without a report for so long [s] it is away.
SILENCE = 3.5

#: So long [s] an answer may take; a scene with large meshes is loaded meanwhile.
PATIENCE, SCENE_PATIENCE = 5.0, 180.0

#: Of rclpy's parameter client only half is needed; every client costs each turn of an executor.
SERVICES = {
    "pause": SetBool,
    "step": Trigger,
    "reset": Trigger,
    "list_parameters": ListParameters,
    "describe_parameters": DescribeParameters,
    "get_parameters": GetParameters,
    "set_parameters": SetParameters,
}

#: Parameters beside the material's that are shown.
SHOWN = ("speed",)


class FluidClient:
    """A fluid node as seen by `node`.

    Args:
        node: that subscribes and asks.
        name: full name of the fluid node.
        say: called with a line of text when something does not work.
        heard: called with the bytes of each /diagnostics message.

    Attributes:
        facts: newest diagnostics of the simulation, key -> text; empty while the node is away.
        level, message: of these diagnostics.
        scene: value of its parameter `scene`; None when unknown.
        numbers: short name of a parameter -> NumberInfo.
    """

    def __init__(self, node, name, say, heard=None):
        self._node, self.name, self._say, self._heard = node, name, say, heard
        self._short_name = name.rpartition("/")[2]
        self.facts, self.level, self.message = {}, DiagnosticStatus.OK, ""
        self.scene, self.numbers = None, {}
        self._last_report, self._scene_name, self._waiting = None, None, {}
        self._clients = {
            service: node.create_client(kind, f"{name}/{service}")
            for service, kind in SERVICES.items()
        }
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, 10, raw=True)
        node.create_subscription(ParameterEvent, "/parameter_events", self._on_parameters, 100)

    @property
    def paused(self):
        """Whether it says that it is paused."""
        return self.facts.get("state") == "paused"

    @property
    def silence(self):
        """Time since the last report [s]; None before the first."""
        return None if self._last_report is None else time.monotonic() - self._last_report

    def check(self):
        """To be called often: notices that the node is away, and gives up waiting for answers."""
        if self.facts and self.silence > SILENCE:
            self.facts = {}
        now = time.monotonic()
        for future, (deadline, what, client) in list(self._waiting.items()):
            if now > deadline:
                del self._waiting[future]
                client.remove_pending_request(future)
                self._say(f"{what}: {self.name} does not answer")

    # ---------------------------------------------------------------- asking for something

    def pause(self, paused):
        """Stop or go on."""
        what = "pause" if paused else "resume"
        self._ask("pause", SetBool.Request(data=paused), what, self._complain_of(what))

    def trigger(self, button):
        """Call its service `step` or `reset`."""
        self._ask(button, Trigger.Request(), button, self._complain_of(button))

    def set_number(self, name, value):
        """Set a parameter of `numbers`; `say` tells why if it is refused."""
        self._set(Parameter(_full_name(name), value=float(value)), name, PATIENCE)

    def set_scene(self, name, done):
        """Have it take another scene, then call `done`; `say` tells why if it is refused."""
        self._set(Parameter("scene", value=name), "scene", SCENE_PATIENCE, done)

    def _set(self, parameter, what, patience, done=None):
        def answered(response):
            result = response.results[0]
            if not result.successful:
                self._say(f"{what}: {result.reason}")
            elif done is not None:
                done()
            self._ask_values()  # shown again, whatever was wanted

        request = SetParameters.Request(parameters=[parameter.to_parameter_msg()])
        self._ask("set_parameters", request, what, answered, patience)

    def _complain_of(self, what):
        def answered(response):
            if not response.success:
                self._say(f"{what}: {response.message}")

        return answered

    def _ask(self, service, request, what, answered, patience=PATIENCE):
        """Call a service; `answered` gets the response, if it comes in time."""
        client = self._clients[service]
        if not client.service_is_ready():
            self._say(f"{what}: no fluid node {self.name}")
            return
        future = client.call_async(request)
        self._waiting[future] = (time.monotonic() + patience, what, client)

        def done(future):
            # What comes late, or after the node's end, is of no use.
            if self._waiting.pop(future, None) is None:
                return
            if future.exception() is None:
                answered(future.result())
            else:
                self._say(f"{what}: {future.exception()}")

        future.add_done_callback(done)

    # ---------------------------------------------------------------- what it says

    def _on_report(self, data):
        if self._heard is not None:
            self._heard(data)
        statuses = deserialize_message(data, DiagnosticArray).status
        wanted = f"{self._short_name}: simulation"
        status = next((status for status in statuses if status.name == wanted), None)
        if status is None:
            return
        before, self.facts = self.facts, {item.key: item.value for item in status.values}
        # Known, unless it has just come, has another scene or was restarted.
        known = bool(before) and self._scene_name == status.hardware_id
        known &= _time(before) <= _time(self.facts)
        self.level, self.message = status.level, status.message
        self._last_report, self._scene_name = time.monotonic(), status.hardware_id
        if not known or not self.numbers:
            self._ask_parameters()

    def _on_parameters(self, event):
        if event.node != self.name:
            return
        changed = [*event.new_parameters, *event.changed_parameters]
        self._take({item.name: parameter_value_to_python(item.value) for item in changed})

    def _ask_parameters(self):
        """Names first, then what they are, then their values."""
        if not all(client.service_is_ready() for client in self._clients.values()):
            return  # asked again with the next report

        def named(response):
            request = DescribeParameters.Request(names=[*SHOWN, *response.result.names])
            self._ask("describe_parameters", request, "parameters", described)

        def described(response):
            self.numbers = {
                d.name.removeprefix(MATERIAL_PREFIX): NumberInfo(
                    r.from_value, r.from_value, r.to_value, d.description
                )
                for d in response.descriptors
                for r in d.floating_point_range
            }
            self._ask_values()

        request = ListParameters.Request(prefixes=[MATERIAL_PREFIX.rstrip(".")])
        self._ask("list_parameters", request, "parameters", named)

    def _ask_values(self):
        names = [*map(_full_name, self.numbers), "scene"]

        def answered(response):
            values = map(parameter_value_to_python, response.values)
            self._take(dict(zip(names, values, strict=True)))

        self._ask("get_parameters", GetParameters.Request(names=names), "parameters", answered)

    def _take(self, values):
        """New values of parameters, full name -> value."""
        for full, value in values.items():
            name = full.removeprefix(MATERIAL_PREFIX)
            if full == "scene":
                self.scene = value
            elif name in self.numbers:
                self.numbers = {
                    **self.numbers,
                    name: self.numbers[name]._replace(value=float(value)),
                }


def _full_name(name):
    return name if name in SHOWN else MATERIAL_PREFIX + name


def _time(facts):
    return float(facts.get("simulated_time", "0"))
