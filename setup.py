# SPDX-License-Identifier: Apache-2.0
"""Metadata of the package, all of it: colcon and pip both read it here."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "sph_ros"
# Resolved, because colcon build --symlink-install runs a link to this file.
ROOT = Path(__file__).resolve().parent
SHARED_FOLDERS = ("scenes", "launch", "rviz", "foxglove")

# Jazzy's rclpy from PyPI, for machines without an apt-installed ROS. Never in install_requires: on
# a ROS machine these come from apt, and the names ros-<package> are shared among ROS releases.
ROS_WHEELS = [
    f"{wheel}; sys_platform == 'linux' and platform_machine == 'x86_64'"
    for wheel in (
        "ros-jazzy-rclpy==7.1.6",
        "ros-jazzy-common-interfaces==5.3.6",
        "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
    )
]


def shared_files():
    """(target folder, [files]) of everything that goes to share/sph_ros, folders kept."""
    by_folder = {}
    for folder in SHARED_FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                relative = path.relative_to(ROOT)
                by_folder.setdefault(f"share/{NAME}/{relative.parent}", []).append(str(relative))
    return sorted(by_folder.items())


setup(
    name=NAME,
    version="0.1.0",
    description="A real-time particle liquid for ROS 2, stirred and poured by pose messages.",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="The sph_ros authors",
    maintainer="The sph_ros authors",
    maintainer_email="sph_ros@users.noreply.github.com",
    license="Apache-2.0",
    packages=find_packages(include=["sph_ros", "sph_ros.*", "msg_adapters", "msg_adapters.*"]),
    python_requires=">=3.11",
    install_requires=[
        "setuptools",
        "numpy",
        "numba",
        "scipy",
        "scikit-image",
        "trimesh",
        "opencv-python-headless",
        "pyyaml",
        "rosbags",
        "imageio-ffmpeg",
        "matplotlib",
        "viser",
        "tqdm",
    ],
    extras_require={
        "ros": ROS_WHEELS,
        # Playwright drives the installed Chromium in the tests of web_viewer: mouse, keys, pixels.
        "test": ["pytest", "ruff", "playwright"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared_files(),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "fluid_node = sph_ros.nodes.fluid_node:main",
            "bag_player = sph_ros.nodes.bag_player:main",
            "marker_tracker = sph_ros.nodes.marker_tracker:main",
            "ar_overlay = sph_ros.nodes.ar_overlay:main",
            "web_viewer = sph_ros.nodes.web_viewer:main",
            "sph_ros = sph_ros.cli:main",
        ],
    },
)
