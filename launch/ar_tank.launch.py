# SPDX-License-Identifier: Apache-2.0
"""Water on your desk with a full ROS desktop: camera or bag, tracker, fluid, overlay, RViz.

    ros2 launch sph_ros ar_tank.launch.py                          # camera 0
    ros2 launch sph_ros ar_tank.launch.py source:=desk.mcap        # a bag, a video, a folder
    ros2 launch sph_ros ar_tank.launch.py source:='' image:=/camera/image_raw \
        camera_info:=/camera/camera_info                           # a camera driver's topics
    ros2 launch sph_ros ar_tank.launch.py rviz:=false web:=true    # a browser instead of RViz

`ros2 launch sph_ros ar_tank.launch.py --show-args` lists all arguments.
"""

from typing import List  # noqa: UP035 (what launch_ros knows)

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

# Name, default, description.
ARGUMENTS = (
    ("scene", "desk_tank", "packaged name or path of a YAML file"),
    ("source", "0", "camera number, video file, folder or bag; '' for image topics"),
    ("loop", "true", "whether a video, folder or bag starts over at its end"),
    ("camera_info_url", "", "calibration (ROS or OpenCV YAML); '' for the camera_info topic"),
    ("image", "/marker_tracker/image", "pictures: a camera driver's, or those of `source`"),
    ("camera_info", "/marker_tracker/camera_info", "calibration that belongs to them"),
    ("solid", "ball", "solid that the marker in the hand moves"),
    ("marker", "1", "id of that marker; the world's is 0"),
    ("marker_size", "0.08", "side of the printed black squares [m]"),
    ("card", "0.112", "side of the paper around the marker in the hand [m]"),
    ("rviz", "true", "whether RViz is started"),
    ("web", "false", "whether the page for a browser is served"),
    ("port", "8080", "of that page"),
)


def generate_launch_description():
    """The nodes, connected."""
    given = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}

    def text(name):
        # Else '0' would become a number and '' nothing at all.
        return ParameterValue(given[name], value_type=str)

    def value(name, kind=float):
        return ParameterValue(given[name], value_type=kind)

    def one_text(*parts):
        return ParameterValue(["['", *parts, "']"], value_type=List[str])  # noqa: UP006

    tracker = Node(
        package="sph_ros",
        executable="marker_tracker",
        parameters=[
            {
                "source": text("source"),
                "loop": value("loop", bool),
                "camera_info_url": text("camera_info_url"),
                "marker_size": value("marker_size"),
                "solid_markers": one_text(given["solid"], ":", given["marker"]),
            }
        ],
        remappings=[
            ("image", given["image"]),
            ("camera_info", given["camera_info"]),
            (
                ["/marker_tracker/", given["solid"], "/pose"],
                ["/fluid/solids/", given["solid"], "/pose"],
            ),
        ],
    )
    fluid = Node(package="sph_ros", executable="fluid_node", parameters=[{"scene": text("scene")}])
    overlay = Node(
        package="sph_ros",
        executable="ar_overlay",
        parameters=[{"cards": one_text(given["solid"], ":", given["card"])}],
        remappings=[("image", given["image"]), ("camera_info", given["camera_info"])],
    )
    web = Node(
        package="sph_ros",
        executable="web_viewer",
        parameters=[{"port": value("port", int)}],
        condition=IfCondition(given["web"]),
    )
    settings = PathJoinSubstitution([FindPackageShare("sph_ros"), "rviz", "sph_ros.rviz"])
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", settings],
        condition=IfCondition(given["rviz"]),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in ARGUMENTS
    ]
    return LaunchDescription([*declared, tracker, fluid, overlay, web, rviz])
