# SPDX-License-Identifier: Apache-2.0
"""Real rclpy in tests without the launch system: one private context per test, real processes.

    with RosSession("listener") as ros:
        poses = ros.collect(PoseStamped, "/hand/pose")
        player = ros.start("sph_ros.nodes.bag_player", str(bag), "--rate", "4")
        ros.wait_for(lambda: len(poses) >= 10, timeout=20.0)
        output = player.interrupt()          # SIGINT, then wait; also .terminate()
        assert player.returncode == 0, output

Every session has a DDS domain of its own and stays on 127.0.0.1. Processes started by a session
share its domain and are ended with it. Nothing sleeps for a fixed time: conditions have deadlines.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

# Before rclpy: discovery range and log folder are read when the middleware starts.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_LOCALHOST_ONLY", None)
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="ros_log_"))

import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[1]
_session_numbers = itertools.count()


def unused_domain_id() -> int:
    """Domain id in 1..101, another one for each test worker and each of its sessions."""
    return 1 + (os.getpid() * 7 + next(_session_numbers)) % 101


def _read_file(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


class Program:
    """A program in its own process; its output goes to a file, so that no pipe can fill up."""

    def __init__(self, arguments: list[str], environment: dict[str, str], output_path: Path):
        self._output_path = output_path
        with open(output_path, "wb") as output:
            self.process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                cwd=REPOSITORY,
                start_new_session=True,
            )

    @property
    def output(self) -> str:
        """Everything printed so far, standard output and error together."""
        return _read_file(self._output_path)

    @property
    def returncode(self) -> int | None:
        """Exit status; None while it runs, -N when signal N killed it."""
        return self.process.poll()

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.poll() is None

    def wait(self, timeout: float = 30.0) -> str:
        """Wait for the end and return the output; AssertionError when it does not end in time."""
        try:
            self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            raise AssertionError(f"no end within {timeout} s; output:\n{self.output}") from None
        return self.output

    def interrupt(self, timeout: float = 10.0) -> str:
        """What Ctrl-C does (SIGINT), then wait."""
        self.process.send_signal(signal.SIGINT)
        return self.wait(timeout)

    def terminate(self, timeout: float = 10.0) -> str:
        """SIGTERM, then wait."""
        self.process.send_signal(signal.SIGTERM)
        return self.wait(timeout)

    def kill(self) -> None:
        """End it and everything it started, whatever state it is in."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()


class RosSession:
    """A private rclpy context, one node, an executor in a thread, and processes on the same domain.

    Args:
        name: Name of the session's node.
        domain_id: DDS domain, 1..101; by default one that hardly any other session uses.
    """

    def __init__(self, name: str = "test", domain_id: int | None = None):
        self.domain_id = unused_domain_id() if domain_id is None else domain_id
        if not 1 <= self.domain_id <= 101:
            raise ValueError(f"domain_id is {self.domain_id}, expected 1 to 101")
        self._name = name
        self._nodes: list[Node] = []
        self._programs: list[Program] = []
        self._error: BaseException | None = None

    def __enter__(self) -> RosSession:
        self._folder = tempfile.TemporaryDirectory(prefix="ros_session_")
        self.context = Context()
        rclpy.init(
            context=self.context,
            domain_id=self.domain_id,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = self.add(rclpy.create_node(self._name, context=self.context))
        self._thread = threading.Thread(target=self._spin, name=f"spin_{self._name}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        for program in self._programs:
            program.kill()
        # This order, or the thread still spins in a context that is gone (and the process aborts).
        self.executor.shutdown()
        self._thread.join(timeout=10.0)
        for node in reversed(self._nodes):
            node.destroy_node()
        self.context.try_shutdown()
        self._folder.cleanup()
        if exception[0] is None and self._error is not None:
            raise self._error

    def _spin(self) -> None:
        try:
            self.executor.spin()
        except ExternalShutdownException:
            pass
        except BaseException as error:  # handed to the test in wait_for or at the end
            self._error = error

    def add(self, node: Node) -> Node:
        """Spin another node, made with ``context=session.context``; destroyed with the session."""
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def wait_for(
        self, condition: Callable[[], object], timeout: float = 20.0, what: str = ""
    ) -> object:
        """First true value of ``condition()``; AssertionError after ``timeout`` seconds."""
        deadline = time.monotonic() + timeout
        while True:
            value = condition()
            if value:
                return value
            if self._error is not None:
                raise self._error
            if time.monotonic() > deadline:
                outputs = "\n".join(program.output for program in self._programs)
                raise AssertionError(
                    f"waited {timeout} s in vain {what}; programs said:\n{outputs}"
                )
            time.sleep(0.005)

    def collect(
        self, message_type: type, topic: str, qos: QoSProfile | int = 1000, raw: bool = False
    ) -> list:
        """A list to which every message of ``topic`` is appended (bytes when ``raw``)."""
        messages: list = []
        self.node.create_subscription(message_type, topic, messages.append, qos, raw=raw)
        self.executor.wake()
        return messages

    def call(self, service_type: type, name: str, request: object, timeout: float = 20.0) -> object:
        """Call a service and return its response; AssertionError when there is none in time."""
        client = self.node.create_client(service_type, name)
        try:
            self.wait_for(client.service_is_ready, timeout, f"for the service {name}")
            future = client.call_async(request)
            self.executor.wake()
            self.wait_for(future.done, timeout, f"for the response of {name}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def environment(self, **extra: str) -> dict[str, str]:
        """Environment for a process on this session's domain that finds this repository."""
        paths = [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]
        return {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path for path in paths if path),
            "PYTHONUNBUFFERED": "1",
            "ROS_DOMAIN_ID": str(self.domain_id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            **extra,
        }

    def start(self, module: str, *arguments: str, **extra_environment: str) -> Program:
        """Run ``python -m module arguments...`` on this domain; ended with the session."""
        command = [sys.executable, "-m", module, *arguments]
        output_path = Path(self._folder.name) / f"output_{len(self._programs)}.txt"
        program = Program(command, self.environment(**extra_environment), output_path)
        self._programs.append(program)
        return program
