# SPDX-License-Identifier: Apache-2.0
"""`sph_ros validate`: a short form of the checks passes, and the command tells what does not."""

import csv
import math

import numpy as np
import pytest

from sph_ros.cli import main
from sph_ros.sim.abilities import LIQUID_SOLVERS
from sph_ros.sim.guards import UnstableError
from sph_ros.validation import checks, dam_break, floating
from sph_ros.validation.case import Case, NotAvailableError
from sph_ros.validation.drops import sphericity
from sph_ros.validation.rows import Curve, Plot, Row, relative_row

SHORT = ["column", "outflow", "momentum"]


def test_the_short_form_of_some_checks_passes_and_leaves_plots_and_numbers(tmp_path, capsys):
    out = tmp_path / "out"
    status = main(["validate", *SHORT, "--quick", "--solver", "incompressible", "--out", str(out)])
    text = capsys.readouterr().out
    assert status == 0, text
    assert text.count("pass") == 4 and "FAIL" not in text
    with open(out / "results.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["check"] for row in rows] == ["column", "outflow", "momentum", "momentum"]
    assert all(float(row["error"]) <= float(row["within"]) for row in rows)
    names = {path.name for path in out.iterdir()}
    assert names == {"results.csv", "column.png", "outflow.png", "momentum.png"}


def test_relaxation_pushes_a_plate_with_the_viscosity_asked_for():
    """Friction at the plates is part of the implicit viscosity: the first layers do not slip."""
    (row,) = checks.run_check("couette", Case("relaxation", quick=True)).rows
    assert row.passed, row


def test_honey_is_pushed_through_a_channel_at_the_pace_of_the_piston():
    """Pistons hit the liquid at full speed; it neither bursts nor flows as a plug."""
    (row,) = checks.run_check("poiseuille", Case("incompressible", quick=True)).rows
    assert row.passed, row


def fake(monkeypatch, **outcomes):
    """Checks that answer at once: name -> error, or an exception."""

    def check(name, outcome):
        def run(case):
            case.tell("half done", 0.5)
            if isinstance(outcome, BaseException):
                raise outcome
            curve = Curve("measured", np.arange(3), np.arange(3))
            return [
                relative_row(
                    name, 10.0, 10.0 * (1 + outcome), "m", 0.05, plot=Plot("x", "y", (curve,))
                )
            ]

        return run, name

    made = {name: check(name, outcome) for name, outcome in outcomes.items()}
    monkeypatch.setattr(checks, "CHECKS", made)


@pytest.mark.parametrize(("solver", "status"), [("incompressible", 1), ("relaxation", 0)])
def test_only_the_solver_that_must_pass_fails_the_command(
    solver, status, tmp_path, monkeypatch, capsys
):
    fake(monkeypatch, good=0.01, bad=0.2, gone=NotAvailableError("no such thing"))
    arguments = ["validate", "--solver", solver, "--out", str(tmp_path)]
    assert main(arguments) == status
    caught = capsys.readouterr()
    lines = {line.split()[0]: line for line in caught.out.splitlines() if line.startswith("  ")}
    assert "1 %" in lines["good"] and "pass" in lines["good"]
    assert "20 %" in lines["bad"] and "FAIL" in lines["bad"]
    assert "not available: no such thing" in lines["gone:"]
    assert ("bad (incompressible)" in caught.err) == bool(status)
    assert "gone" not in caught.err


def test_what_explodes_is_a_failure_and_the_others_still_run(tmp_path, monkeypatch, capsys):
    fake(monkeypatch, first=UnstableError("step 3: particle 5 became no number"), second=0.0)
    assert main(["validate", "--solver", "incompressible", "--out", str(tmp_path)]) == 1
    text = capsys.readouterr().out
    assert "first: unstable: step 3" in text and "second" in text


def test_ctrl_c_keeps_what_is_finished(tmp_path, monkeypatch, capsys):
    fake(monkeypatch, first=0.0, second=KeyboardInterrupt(), third=0.0)
    assert main(["validate", "--solver", "relaxation", "--out", str(tmp_path)]) == 130
    caught = capsys.readouterr()
    assert "first" in caught.out and "third" not in caught.out
    assert "interrupted" in caught.err
    assert (tmp_path / "results.csv").exists()


def test_markdown_has_a_column_for_each_solver_and_failures_in_bold(tmp_path, monkeypatch, capsys):
    fake(monkeypatch, good=0.01, bad=0.2)
    main(["validate", "--markdown", "--out", str(tmp_path)])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert lines[0].split("|")[4:-1] == [f" `{solver}` " for solver in LIQUID_SOLVERS]
    assert lines[2] == "| good | 10 m | 5 % |" + " 10.1 (1 %) |" * len(LIQUID_SOLVERS)
    assert lines[3].count("**12 (20 %)**") == len(LIQUID_SOLVERS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["colum"], "no check 'colum'; did you mean 'column'?"),
        (["--solver", "magic"], "--solver: expected all or one of"),
        (["--data", "missing.csv"], "--data: missing.csv: no such file"),
    ],
)
def test_mistakes_get_one_line(arguments, words, capsys):
    assert main(["validate", *arguments]) == 1
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_the_curve_of_the_dam_break_runs_through_the_published_points(shared_data):
    path = shared_data / "measurements" / "dam_break_front_koshizuka_oka_1996.csv"
    times, fronts = dam_break.read_points(path)
    used = times <= dam_break.CURVE_END
    np.testing.assert_allclose(dam_break.front_curve(times)[used], fronts[used], rtol=0.045)


def test_points_that_are_none_are_refused(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("T,Z\n1,2,3\n")
    with pytest.raises(NotAvailableError, match="points.csv"):
        dam_break.read_points(path)


def test_truths_by_hand():
    assert floating.draft_of(0.5) == pytest.approx(1.0)  # half of a ball is below its middle
    assert 0.0 < floating.draft_of(0.1) < floating.draft_of(0.9) < 2.0
    none = Row("x", 1.0, math.nan, "", math.nan, 0.05)
    assert not none.passed  # what is no number does not pass
    ball = Case("relaxation").simulation(
        spacing=0.001, gravity=[0, 0, 0], liquid=[{"sphere": {"radius": 0.009}}]
    )
    cube = Case("relaxation").simulation(
        spacing=0.001, gravity=[0, 0, 0], liquid=[{"box": {"size": [0.016, 0.016, 0.016]}}]
    )
    # A cube has 0.806; the mesh rounds its edges by a spacing.
    assert 0.8 < sphericity(cube) < 0.9 < 0.975 < sphericity(ball) <= 1.0
