# SPDX-License-Identifier: Apache-2.0
"""The program `sph_ros`: what it prints, its exit status, and one line for every mistake."""

import subprocess
import sys
from pathlib import Path

import pytest

from sph_ros import cli
from sph_ros.sim.scene import list_scenes

ROOT = Path(__file__).resolve().parents[1]


def run(capsys, *arguments):
    """(exit status, standard output, standard error) of `sph_ros ARGUMENTS`."""
    try:
        status = cli.main([str(argument) for argument in arguments])
    except SystemExit as done:
        status = done.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from sph_ros import cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'numba', 'rclpy', 'yaml'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.endswith("[]\n")
    for command in ("scenes", "check", "simulate", "demo"):
        assert command in done.stdout


def test_scenes_lists_every_scene_with_a_description(capsys):
    status, out, _ = run(capsys, "scenes")
    assert status == 0
    lines = [line.split(maxsplit=1) for line in out.splitlines()]
    assert [name for name, _ in lines] == list_scenes()
    assert all(len(description) > 10 for _, description in lines)


def test_check_says_what_a_scene_needs(capsys):
    status, out, error = run(capsys, "check", "dam_break")
    assert status == 0 and error == ""
    assert "5,120 of water" in out and "ms (chosen)" in out and "tank (fixed)" in out


def test_check_refuses_with_one_line(capsys, tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("spacing: 0.02\nliquid:\n  - box: {min: [0, 0, 0], mx: [1, 1, 1]}\n")
    status, out, error = run(capsys, "check", file)
    assert status == 1 and out == "" and error.count("\n") == 1
    assert f"{file}:3: liquid[0].box.mx: unknown key; did you mean 'max'" in error
    status, _, error = run(capsys, "check", "ball_tanc")
    assert status == 1 and "did you mean 'ball_tank'" in error


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["simulate", "ball_tank", "--bag", "hand_stri"], "did you mean 'hand_stir'"),
        (["simulate", "ball_tank", "--remap", "/a:=ball"], "--bag"),
        (["simulate", "dam_break", "--bag", "hand_stir"], "control: topic"),
        (["simulate", "ball_tank", "--bag", "hand_stir", "--remap", "/a:=ball"], "no topic /a"),
        (["simulate", "nothing.yaml"], "no such file"),
    ],
)
def test_simulate_refuses_before_it_writes(capsys, tmp_path, arguments, expected):
    status, out, error = run(capsys, *arguments, "--out", tmp_path / "out")
    assert status == 1 and out == "" and error.count("\n") == 1
    assert expected in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["simulat"],
        ["simulate", "dam_break", "--seconds", "-1"],
        ["simulate", "dam_break", "--seconds", "nan"],
        ["simulate", "dam_break", "--size", "100"],
        ["simulate", "dam_break", "--fps", "0"],
        ["simulate", "dam_break", "--remap", "a=b"],
    ],
)
def test_wrong_options_are_explained(capsys, arguments):
    status, _, error = run(capsys, *arguments)
    assert status == 2 and "usage: sph_ros" in error


def test_bags_that_cannot_be_used(capsys, tmp_path, shared_data):
    out = tmp_path / "out"
    official = shared_data / "bags" / "rosbag2_official"
    empty = next(folder for folder in official.rglob("*empty*") if folder.is_dir())
    broken = tmp_path / "broken.mcap"
    whole = next((shared_data / "bags" / "fr1_xyz_mocap_mcap").glob("*.mcap")).read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    webcam = shared_data / "bags" / "webcam_sksurgery_mcap"
    for bag, expected in ((empty, "messages"), (broken, "truncated"), (webcam, "PoseStamped")):
        status, _, error = run(capsys, "simulate", "ball_tank", "--bag", bag, "--out", out)
        assert status == 1 and str(bag) in error and expected in error, error
        assert error.count("\n") == 1 and not out.exists()


def test_a_folder_that_cannot_be_made_is_named(capsys, tmp_path):
    scene = tmp_path / "drop.yaml"
    scene.write_text("spacing: 0.02\nliquid:\n  - box: {min: [0, 0, 0], max: [0.1, 0.1, 0.1]}\n")
    arguments = [scene, "--seconds", "0.01", "--no-video", "--out", "/proc/results/here"]
    status, out, error = run(capsys, "simulate", *arguments)
    assert status == 1 and out == "" and error.count("\n") == 1
    assert "/proc/results" in error


def test_demo_has_its_own_options(capsys):
    status, out, _ = run(capsys, "demo", "--help")
    assert status == 0 and "--headless" in out
