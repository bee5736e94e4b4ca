# SPDX-License-Identifier: Apache-2.0
"""``--help`` of programs whose options are ROS parameters: their names, defaults, ranges, texts."""

import textwrap
from types import SimpleNamespace

#: Width of a terminal that every user has [characters].
WIDTH = 100


class ParameterList:
    """Stands in for a node while parameters are declared, and remembers what they are."""

    def __init__(self):
        self._declared = {}

    def declare_parameter(self, name, default, descriptor):
        """Remember a parameter; its value is the default."""
        parameter = SimpleNamespace(value=default, descriptor=descriptor)
        self._declared[name] = parameter
        return parameter

    def get_parameter(self, name):
        """What was declared."""
        return self._declared[name]

    def add_on_set_parameters_callback(self, callback):
        """Nothing is ever set."""

    def text(self):
        """Everything that was declared, for people."""
        lines = []
        for name, parameter in self._declared.items():
            descriptor = parameter.descriptor
            notes = [f"default {_shown(parameter.value)}"]
            limits = [*descriptor.floating_point_range, *descriptor.integer_range]
            notes += [f"{one.from_value:g} to {one.to_value:g}" for one in limits]
            notes += ["fixed once it runs"] if descriptor.read_only else []
            text = f"{descriptor.description} ({'; '.join(notes)})"
            body = textwrap.wrap(text, WIDTH - 6, break_on_hyphens=False)
            lines += [f"  {name}", *(f"      {line}" for line in body)]
        return "\n".join(lines)


def help_text(program, summary, declare):
    """What ``--help`` prints.

    Args:
        program: its name.
        summary: what it does, in a sentence.
        declare: declares the program's parameters on the node that it gets.
    """
    parameters = ParameterList()
    declare(parameters)
    return (
        f"usage: {program} [-h] [--ros-args -p PARAMETER:=VALUE ... -r TOPIC:=OTHER ...]\n\n"
        f"{summary}\n\nparameters:\n{parameters.text()}\n\nThe README names its topics."
    )


def _shown(value):
    if isinstance(value, float):
        return f"{value:g}"
    return repr(value) if isinstance(value, str) else str(value)
