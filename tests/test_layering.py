# SPDX-License-Identifier: Apache-2.0
"""The borders: core <- sim <- nodes; msg_adapters knows none of them; rclpy only in nodes."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Package -> what its modules may not import, at any place in the file.
FORBIDDEN = {
    "sph_ros/core": ("sph_ros.sim", "sph_ros.nodes", "sph_ros.render", "msg_adapters", "rclpy"),
    "sph_ros/sim": ("sph_ros.nodes", "sph_ros.render", "msg_adapters", "rclpy"),
    "sph_ros/render": ("sph_ros.nodes", "rclpy"),
    "sph_ros/tracking": ("sph_ros.nodes", "rclpy"),
    "msg_adapters": ("sph_ros",),
}


def imported_modules(path, top_level_only=False):
    """Full names of all modules that a file imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level_only else ast.walk(tree)
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def crosses(name, border):
    return name == border or name.startswith(border + ".")


@pytest.mark.parametrize("folder", FORBIDDEN)
def test_no_module_looks_across_its_border(folder):
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files
    wrong = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imported_modules(path)
        for border in FORBIDDEN[folder]
        if crosses(name, border)
    }
    assert not wrong


def test_only_nodes_import_rclpy_when_loaded():
    outside = [
        path
        for package in ("sph_ros", "msg_adapters")
        for path in (ROOT / package).rglob("*.py")
        if "nodes" not in path.parts
    ]
    wrong = [
        str(path.relative_to(ROOT))
        for path in outside
        for name in imported_modules(path, top_level_only=True)
        if crosses(name, "rclpy")
    ]
    assert not wrong


@pytest.mark.parametrize(
    "module", ["sph_ros", "sph_ros.sim.scene", "sph_ros.sim.simulation", "sph_ros.simulate"]
)
def test_a_fresh_interpreter_does_not_load_rclpy(module):
    code = (
        f"import {module}, sys; "
        "print([m for m in sys.modules if m.split('.')[0] in ('rclpy', 'rosidl_runtime_py')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
