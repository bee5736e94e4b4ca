# SPDX-License-Identifier: Apache-2.0
"""What people with a full ROS desktop get: a launch file and layouts for RViz and Foxglove."""

import ast
import importlib
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from ros_helpers import RosSession

ROOT = Path(__file__).resolve().parents[1]
NODES = ROOT / "sph_ros" / "nodes"
LAUNCH = ROOT / "launch" / "ar_tank.launch.py"
SETUP = (ROOT / "setup.py").read_text(encoding="utf-8")
PROGRAMS = dict(re.findall(r'"(\w+) = ([\w.]+):main"', SETUP))

#: Node name -> files that create its publishers, and program.
PUBLISHERS = {
    "fluid": ("publications.py", "fluid_node"),
    "marker_tracker": ("marker_publications.py", "marker_tracker"),
    "ar_overlay": ("ar_overlay.py", "ar_overlay"),
}

#: Display of RViz -> type of its messages.
DISPLAYS = {
    "Marker": "Marker",
    "MarkerArray": "MarkerArray",
    "PointCloud2": "PointCloud2",
    "Pose": "PoseStamped",
    "Image": "Image",
}


def published():
    """Topic -> message type of what the nodes publish under names of their own."""
    topics = {"/diagnostics": "DiagnosticArray", "/fluid/solids/ball/wrench": "WrenchStamped"}
    for node, (file, _) in PUBLISHERS.items():
        text = (NODES / file).read_text(encoding="utf-8")
        for kind, name in re.findall(r'\(\s*(\w+),\s*"~/([\w/]+)"', text):
            topics[f"/{node}/{name}"] = kind
    return topics


def nodes_in(path):
    """Keywords of every Node(...) in a launch file, as syntax."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
    names = [call for call in calls if getattr(call.func, "id", "") == "Node"]
    return [{keyword.arg: keyword.value for keyword in call.keywords} for call in names]


def test_the_launch_file_names_programs_and_parameters_that_exist():
    seen = set()
    for node in nodes_in(LAUNCH):
        program = node["executable"].value
        seen.add(program)
        if node["package"].value != "sph_ros":
            continue
        module = importlib.import_module(PROGRAMS[program])
        imported = re.findall(r"from (sph_ros\.nodes\.\w*parameters) import", source(module))
        texts = [source(module), *(source(importlib.import_module(name)) for name in imported)]
        for parameters in getattr(node.get("parameters"), "elts", []):
            for key in parameters.keys:
                assert any(f'"{key.value}"' in text for text in texts), (program, key.value)
    assert seen == {"marker_tracker", "fluid_node", "ar_overlay", "web_viewer", "rviz2"}


def source(module):
    return Path(module.__file__).read_text(encoding="utf-8")


def test_rviz_shows_what_the_nodes_publish():
    settings = yaml.safe_load((ROOT / "rviz" / "sph_ros.rviz").read_text(encoding="utf-8"))
    manager, topics = settings["Visualization Manager"], published()
    assert manager["Global Options"]["Fixed Frame"] == "world"
    shown = {}
    for display in manager["Displays"]:
        kind = display["Class"].partition("/")[2]
        if "Topic" in display:
            shown[display["Topic"]["Value"]] = kind
            assert topics[display["Topic"]["Value"]] == DISPLAYS[kind], display["Name"]
            # Best effort would lose large messages.
            assert display["Topic"]["Reliability Policy"] == "Reliable"
    assert {"/fluid/surface", "/fluid/solids", "/fluid/particles", "/ar_overlay/image"} <= set(
        shown
    )


def leaves(layout):
    """Panels of a Foxglove layout."""
    if isinstance(layout, str):
        return [layout]
    return leaves(layout["first"]) + leaves(layout["second"])


def test_foxglove_shows_what_the_nodes_publish():
    layout = json.loads((ROOT / "foxglove" / "sph_ros.json").read_text(encoding="utf-8"))
    panels, topics = layout["configById"], published()
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    named = set(panels["3D!liquid"]["topics"])
    named.add(panels["Image!overlay"]["imageMode"]["imageTopic"])
    named |= {path["value"].partition(".")[0] for path in panels["Plot!force"]["paths"]}
    named.add(panels["DiagnosticSummary!all"]["topicToRender"])
    assert named <= set(topics), named - set(topics)
    fluid = (NODES / "fluid_node.py").read_text(encoding="utf-8")
    assert f'"~/{panels["CallService!reset"]["serviceName"].rpartition("/")[2]}"' in fluid


def test_all_of_it_is_installed():
    folders = re.search(r"SHARED_FOLDERS = \(([^)]*)\)", SETUP)[1]
    assert {"launch", "rviz", "foxglove"} <= set(re.findall(r"\w+", folders))


@pytest.fixture
def prefix(tmp_path):
    """A folder that looks to `launch` as if sph_ros were installed there."""
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "sph_ros").touch()
    programs = tmp_path / "lib" / "sph_ros"
    programs.mkdir(parents=True)
    for name, module in PROGRAMS.items():
        program = programs / name
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n')
        program.chmod(0o755)
    return tmp_path


RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
service = LaunchService(noninteractive=True)
arguments = [text.split(":=") for text in sys.argv[2:]]
service.include_launch_description(LaunchDescription([IncludeLaunchDescription(
    sys.argv[1], launch_arguments=arguments)]))
sys.exit(service.run())
"""


def test_the_launch_file_starts_nodes_that_talk_to_each_other(prefix, tmp_path):
    for package in ("launch", "launch_ros"):
        reason = f"{package} is not installed; it comes with a ROS desktop, not from PyPI"
        pytest.importorskip(f"{package}.actions", reason=reason)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    cv2.imwrite(str(pictures / "white.png"), np.full((120, 160, 3), 255, np.uint8))
    arguments = (f"source:={pictures}", "scene:=ball_tank", "rviz:=false", "web:=false")
    with RosSession("desktop") as ros:
        environment = ros.environment(AMENT_PREFIX_PATH=str(prefix))
        log = tmp_path / "log.txt"
        with open(log, "wb") as output:
            launch = subprocess.Popen(
                [sys.executable, "-c", RUN, str(LAUNCH), *arguments],
                env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                start_new_session=True,
            )  # fmt: skip
        try:
            wait_for_nodes(ros, launch, log)
            launch.send_signal(signal.SIGINT)
            assert launch.wait(30.0) == 0, log.read_text()
        finally:
            if launch.poll() is None:
                launch.send_signal(signal.SIGINT)  # it ends what it started
                launch.wait(30.0)
        assert "Traceback" not in log.read_text(), log.read_text()


def wait_for_nodes(ros, launch, log):
    """Until all nodes are there, and the tracker's poses go to the fluid."""
    topic, wanted = "/fluid/solids/ball/pose", {"fluid", "marker_tracker", "ar_overlay"}

    def connected():
        assert launch.poll() is None, log.read_text()
        senders = ros.node.get_publishers_info_by_topic(topic)
        listeners = ros.node.get_subscriptions_info_by_topic(topic)
        return (
            "marker_tracker" in {info.node_name for info in senders}
            and "fluid" in {info.node_name for info in listeners}
            and wanted <= set(ros.node.get_node_names())
        )

    ros.wait_for(connected, 120.0, "for the nodes")
