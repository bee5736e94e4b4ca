# SPDX-License-Identifier: Apache-2.0
"""From a node's constructor to a clean end of its process."""

import signal
import sys

import rclpy
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

PARAMETER_ERRORS = (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
)


class _Terminated(BaseException):
    """SIGINT or SIGTERM came."""


class _ArgumentError(ValueError):
    """The ROS arguments cannot be understood."""


def run_node(program, make_node, argv=None, errors=(), explain=None):
    """Make a node, spin it until SIGINT or SIGTERM, and leave nothing behind.

    Args:
        program: its name, for error messages.
        make_node: called without arguments after `rclpy.init`.
        argv: arguments after the program's name; None for those of the process.
        errors: exception types that are the user's mistakes: one line instead of a traceback.
        explain: makes the text of ``--help``; with it all other arguments must be ROS's.

    Returns:
        The exit status: 0 after a signal or ``--help``, 1 after an error, 2 for wrong arguments.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    own = argv[: argv.index("--ros-args")] if "--ros-args" in argv else argv
    if own and explain is not None:
        return _answer(program, own, explain)
    # Python's own handlers end a long start (compiling) at once; rclpy's would wait for spin.
    signal.signal(signal.SIGINT, _terminate)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        _init(argv)
        node = make_node()
    except _Terminated:
        rclpy.try_shutdown()
        return 0
    except (*errors, *PARAMETER_ERRORS, _ArgumentError) as error:
        print(f"{program}: error: {' '.join(str(error).split())}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    return _spin(node)


def _answer(program, own, explain):
    """Explain the program, or say what is wrong with its own arguments; returns the exit status."""
    if {"-h", "--help"} & set(own):
        print(explain())
        return 0
    print(
        f"{program}: error: unknown argument {own[0]!r}; parameters are set with --ros-args -p "
        "NAME:=VALUE, and --help lists them",
        file=sys.stderr,
    )
    return 2


def _init(argv):
    try:
        rclpy.init(args=["node", *argv], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # what stands after --ros-args
        raise _ArgumentError(error) from error


def _spin(node):
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            # With a timeout: a signal does not wake up the wait, Python acts on it afterwards.
            executor.spin_once(timeout_sec=0.1)
    except (_Terminated, ExternalShutdownException):
        pass
    finally:
        # The end must not be ended half-way by an impatient second signal.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _terminate(_number, _frame):
    raise _Terminated
