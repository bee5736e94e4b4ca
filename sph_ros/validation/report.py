# SPDX-License-Identifier: Apache-2.0
"""Outcomes as a table for a terminal, as markdown for the README, as CSV and as plots."""

import csv
import datetime
import os
import platform
from pathlib import Path

#: Width of the columns of the table for a terminal.
_NAME, _NUMBER = 50, 20


def text_lines(outcomes):
    """The table for a terminal, line by line."""
    solver = None
    for outcome in outcomes:
        if outcome.solver != solver:
            solver = outcome.solver
            yield f"{solver}"
            yield _line("test", "truth", "measured", "error", "within", "")
        for row in outcome.rows:
            unit = f" {row.unit}" if row.unit else ""
            yield _line(
                row.name,
                f"{row.truth:.4g}{unit}",
                f"{row.measured:.4g}{unit}",
                share(row.error),
                share(row.within),
                ("pass" if row.passed else "FAIL") + (f"  ({row.remark})" if row.remark else ""),
            )
        if outcome.problem:
            yield f"  {outcome.check}: {outcome.problem}"


def _line(name, truth, measured, error, within, result):
    numbers = f"{truth:>{_NUMBER}}{measured:>{_NUMBER}}{error:>10}{within:>9}"
    return f"  {name:{_NAME}}{numbers}  {result}".rstrip()


def share(value):
    """A share in per cent, or as a power of ten where that says nothing."""
    if value != value:
        return "none"
    if value != 0.0 and abs(value) < 5e-4:
        return f"{value:.1e}"
    return f"{100 * value:.3g} %"


def markdown_lines(outcomes):
    """A table with a column for each solver."""
    solvers = list(dict.fromkeys(outcome.solver for outcome in outcomes))
    names = list(dict.fromkeys(outcome.check for outcome in outcomes))
    by_key = {(outcome.check, outcome.solver): outcome for outcome in outcomes}
    yield "| test | truth | within | " + " | ".join(f"`{solver}`" for solver in solvers) + " |"
    yield "|---|---|---|" + "---|" * len(solvers)
    for name in names:
        found = [by_key.get((name, solver)) for solver in solvers]
        for title, row in _rows_of(found, name):
            cells = [_cell(outcome, title) for outcome in found]
            truth = f"{row.truth:.4g} {row.unit}".strip() if row else ""
            within = share(row.within) if row else ""
            yield f"| {title} | {truth} | {within} | " + " | ".join(cells) + " |"


def _rows_of(outcomes, name):
    """(title, a row of it) of one check, of the first solver that has rows."""
    for outcome in outcomes:
        if outcome is not None and outcome.rows:
            return [(row.name, row) for row in outcome.rows]
    return [(name, None)]


def _cell(outcome, title):
    """One solver's result: the measured number and its error, a failure in bold."""
    if outcome is None:
        return "not run"
    for row in outcome.rows:
        if row.name == title:
            text = f"{row.measured:.4g} ({share(row.error)})"
            return text if row.passed else f"**{text}**"
    if outcome.rows:
        return "not measured"  # say because its form of the check has another length
    return "not available" if outcome.missing else f"**{outcome.problem.partition(':')[0]}**"


def machine():
    """Where and when: processor, cores, date."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} cores, {datetime.date.today().isoformat()}"


def write_csv(path, outcomes):
    """All rows into one file."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        fields = ("check", "solver", "test", "truth", "measured", "unit", "error", "within")
        table.writerow([*fields, "passed", "remark", "seconds"])
        for outcome in outcomes:
            head, seconds = [outcome.check, outcome.solver], f"{outcome.seconds:.1f}"
            for row in outcome.rows:
                numbers = [row.truth, row.measured, row.unit, row.error, row.within]
                table.writerow([*head, row.name, *numbers, row.passed, row.remark, seconds])
            if outcome.problem:
                table.writerow([*head, "", "", "", "", "", "", False, outcome.problem, seconds])


def write_plots(folder, outcomes):
    """A picture for each check: a row of axes for each of its quantities, one for each solver.

    Returns:
        Paths of the pictures.
    """
    paths = []
    for name in dict.fromkeys(outcome.check for outcome in outcomes):
        found = [o for o in outcomes if o.check == name and any(row.plot for row in o.rows)]
        if found:
            paths.append(Path(folder) / f"{name}.png")
            _write_plot(paths[-1], found)
    return paths


def _write_plot(path, outcomes):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = max(len(outcome.rows) for outcome in outcomes)
    columns = len(outcomes)
    figure = Figure(figsize=(5.2 * columns, 3.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for column, outcome in enumerate(outcomes):
        for index in range(rows):
            axis = axes[index, column]
            row = outcome.rows[index] if index < len(outcome.rows) else None
            if row is None or row.plot is None:
                axis.set_visible(False)
                continue
            for curve in row.plot.curves:
                style = "k-" if curve.truth else ".-"
                axis.plot(curve.x, curve.y, style, label=curve.label, linewidth=1.2, markersize=4)
            axis.set_xlabel(row.plot.x_label)
            axis.set_ylabel(row.plot.y_label)
            axis.grid(alpha=0.3)
            axis.legend(fontsize="small")
            verdict = "pass" if row.passed else "FAIL"
            title = f"{row.name}\n{outcome.solver}: error {share(row.error)}, {verdict}"
            axis.set_title(title, fontsize="medium")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        figure.savefig(temporary, dpi=100)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
