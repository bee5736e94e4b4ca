# SPDX-License-Identifier: Apache-2.0
"""What colcon, pip and people read about the package says the same everywhere."""

import ast
import importlib
import re
import sys
import xml.etree.ElementTree
from pathlib import Path

import pytest

from sph_ros.sim.materials import MATERIALS, RANGES
from sph_ros.sim.scene import list_scenes
from sph_ros.sim.share import share_folder

ROOT = Path(__file__).resolve().parents[1]
SETUP = (ROOT / "setup.py").read_text(encoding="utf-8")
MANIFEST = xml.etree.ElementTree.parse(ROOT / "package.xml").getroot()
PROGRAMS = dict(re.findall(r'"(\w+) = ([\w.]+):main"', SETUP))


def version_in_setup():
    return re.search(r'version="([\d.]+)"', SETUP)[1]


def test_versions_agree():
    changelog = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    newest = re.search(r"^(\d+\.\d+\.\d+) \(", changelog, re.MULTILINE)[1]
    assert version_in_setup() == MANIFEST.findtext("version") == newest


def test_package_xml_is_valid():
    assert MANIFEST.get("format") == "3"
    assert MANIFEST.findtext("name") == "sph_ros"
    assert MANIFEST.findtext("export/build_type") == "ament_python"
    try:
        from catkin_pkg.package import parse_package
    except ImportError:
        return  # present wherever colcon is; what stands above holds without it
    parse_package(str(ROOT / "package.xml")).validate()


def test_every_program_can_be_imported():
    assert {"fluid_node", "bag_player", "web_viewer", "sph_ros"} <= set(PROGRAMS)
    for module in PROGRAMS.values():
        if ".nodes." in module:
            pytest.importorskip("rclpy", reason="ROS is not installed: rclpy cannot be imported")
        assert callable(importlib.import_module(module).main)


def test_ros_comes_from_the_extra_only():
    required = re.search(r"install_requires=\[(.*?)\]", SETUP, re.DOTALL)[1]
    assert "ros-jazzy" not in required and "rclpy" not in required
    pinned = re.findall(r'"(ros-jazzy-[\w-]+==[\d.]+)"', SETUP)
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    assert len(pinned) == 3 and set(pinned) <= set(constraints)


def test_every_message_package_that_nodes_import_is_a_dependency():
    declared = {element.text for element in MANIFEST.findall("exec_depend")}
    sources = [*(ROOT / "sph_ros").rglob("*.py"), *(ROOT / "msg_adapters").rglob("*.py")]
    pattern = re.compile(r"^\s*from (\w+_(?:msgs|interfaces|srvs))\.\w+ import", re.MULTILINE)
    for path in sources:
        for package in pattern.findall(path.read_text(encoding="utf-8")):
            assert package in declared, f"{path.name} imports {package}"


# Import name -> name on PyPI, where they differ.
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "skimage": "scikit-image", "yaml": "pyyaml"}
# From a ROS installation or the extra `ros`; packages of messages are checked above.
ROS_MODULES = {"rclpy", "tf2_ros", "ament_index_python", "rcl_interfaces", "builtin_interfaces"}


def test_every_imported_distribution_is_required_and_none_is_idle():
    required = re.search(r"install_requires=\[(.*?)\]", SETUP, re.DOTALL)[1]
    required = set(re.findall(r'"([\w-]+)', required)) - {"setuptools"}
    own = {"sph_ros", "msg_adapters"}
    imported = set()
    for path in [*(ROOT / "sph_ros").rglob("*.py"), *(ROOT / "msg_adapters").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module.split(".")[0])
    imported -= own | ROS_MODULES | set(sys.stdlib_module_names)
    imported = {name for name in imported if not name.endswith(("_msgs", "_srvs"))}
    imported = {DISTRIBUTIONS.get(name, name.replace("_", "-")) for name in imported}
    assert imported - {"llvmlite"} == required  # numba brings llvmlite


def test_the_code_finds_the_files_that_belong_to_it():
    folder = share_folder()
    assert (folder / "package.xml").is_file()
    assert (folder / "scenes" / "ball_tank.yaml").is_file()


def test_the_readme_names_every_program_scene_and_parameter():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for program in PROGRAMS:
        assert f"| `{program}" in readme, program
    section = readme.partition("## Scenes")[2].partition("\n## ")[0]
    listed = re.findall(r"^\| `(\w+)` \| [\d,]+ \|", section, re.MULTILINE)
    assert sorted(listed) == list_scenes()
    source = (ROOT / "sph_ros/nodes/parameters.py").read_text(encoding="utf-8")
    declared = set(re.findall(r'(?:_declare|number)\(\s*"(\w+)"', source))
    assert {"scene", "publish_rate", "smoothing_time"} <= declared
    section = readme.partition("## Parameters of `fluid_node`")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|", section, re.MULTILINE)
    assert {name for name, _ in rows} == declared | {f"material.{field}" for field in RANGES}
    for field, (low, high) in RANGES.items():
        assert dict(rows)[f"material.{field}"].strip().replace(",", "") == f"{low:g} to {high:g}"
    shown = re.findall(r"\]\(docs/scenes/(\w+)\.webp\)", readme)
    assert sorted(shown) == list_scenes()
    for name in shown:
        assert 2_000 < (ROOT / f"docs/scenes/{name}.webp").stat().st_size < 60_000
    for picture in re.findall(r"\]\((docs/\w+\.png)\)", readme):
        assert 10_000 < (ROOT / picture).stat().st_size < 400_000


@pytest.mark.parametrize("program", ["fluid_node", "marker_tracker", "ar_overlay"])
def test_help_names_every_parameter_and_wrong_arguments_are_refused(program, capsys):
    """Of programs whose options are ROS parameters; without starting a node."""
    pytest.importorskip("rclpy", reason="ROS is not installed: rclpy cannot be imported")
    main = importlib.import_module(PROGRAMS[program]).main
    assert main(["--help"]) == 0
    listed = re.findall(r"^  ([\w.]+)$", capsys.readouterr().out, re.MULTILINE)
    name = {"fluid_node": "", "marker_tracker": "marker_", "ar_overlay": "overlay_"}[program]
    source = (ROOT / f"sph_ros/nodes/{name}parameters.py").read_text(encoding="utf-8")
    declared = set(re.findall(r'(?:_declare|number|fixed)\(\s*"(\w+)"', source))
    assert len(declared) >= 6 and declared <= set(listed)
    assert main(["ball_tank"]) == 2
    assert "'ball_tank'" in capsys.readouterr().err


def test_the_table_of_materials_says_what_the_code_says():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    section = readme.partition("## Materials")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|(.*)\|$", section, re.MULTILINE)
    fields = ("density", "viscosity", "surface_tension", "compression", "wall_friction", "adhesion")
    table = {name: [float(cell) for cell in cells.split("|")] for name, cells in rows}
    expected = {name: [getattr(m, field) for field in fields] for name, m in MATERIALS.items()}
    assert table == expected
