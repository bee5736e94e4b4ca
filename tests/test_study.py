# SPDX-License-Identifier: Apache-2.0
"""The study of the dam and the house: its table, its processes, Ctrl-C."""

import csv
import signal
import subprocess
import sys
import time

import pytest

from sph_ros.dam_house import Case, Outcome, answer, run_case, table
from sph_ros.study import StudyError, study

WALLS = [
    Outcome(2.0, 1.0, 0.87, 1.5, 1.2),
    Outcome(2.0, 1.6, 0.02, 1.6, None),
    Outcome(2.0, 2.2, 0.0, 1.6, None),
    Outcome(3.0, 1.0, 0.3, 2.9, 2.0),
    Outcome(3.0, 1.6, 0.0, 2.9, None),
    Outcome(3.0, 2.2, 0.01, 3.0, 4.0),
]


def test_processes_say_the_same_as_one_run_here(tmp_path):
    outcomes = study(
        "dam_house_2d",
        (1.0, 2.2),
        (2.0,),
        seconds=1.5,
        workers=2,
        out=tmp_path / "study",
        progress=lambda futures, **_: futures,
    )
    assert outcomes[0] == run_case(Case(2.0, 1.0, seconds=1.5))
    assert [outcome.height for outcome in outcomes] == [1.0, 2.2]
    assert outcomes[0].past > 0.0 == outcomes[1].past
    assert sorted(path.name for path in (tmp_path / "study").iterdir()) == [
        "study.csv",
        "study.png",
    ]
    with open(tmp_path / "study" / "study.csv", newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[0]["past"]) == outcomes[0].past and rows[1]["wet_from"] == ""


@pytest.mark.nojit
def test_the_table_and_the_answer():
    lines = table(WALLS).splitlines()
    assert lines[0].split() == ["wall", "[m]", "at", "2.00", "at", "3.00"]
    assert lines[1].split() == ["1.00", "wet", "0.87", "wet", "0.30"]
    assert lines[2].split() == ["1.60", "dry", "0.02", "dry", "0.00"]
    # At 3 m a higher wall let more pass, so none of those tried is enough.
    assert answer(WALLS).splitlines() == [
        "wall at 2 m: the house stays dry behind 1.6 m and more",
        "wall at 3 m: the house gets wet behind all",
        "published: dry behind a wall of 2.2 m at 2 m; dry here too",
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("dam_break",), "no study"),
        (("dam_house_2d", (1.0,), (7.0,)), "--positions: expected 2 to 5 m"),
        (("dam_house_2d", (9.0,), (2.0,)), "--heights"),
    ],
)
def test_what_cannot_be_studied_is_refused(arguments, words, tmp_path):
    with pytest.raises(StudyError, match=words):
        study(*arguments, out=tmp_path / "study")
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_all_processes_and_leaves_nothing(tmp_path):
    command = [sys.executable, "-m", "sph_ros.cli", "study", "dam_house_2d", "--out", "study"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60.0
    while not list(tmp_path.glob(".study.*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert list(tmp_path.glob(".study.*"))  # it runs
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30.0)  # ends only when no child holds the pipes
    assert process.returncode == 130
    assert "interrupted" in errors and "Traceback" not in errors
    assert not list(tmp_path.iterdir())
