# SPDX-License-Identifier: Apache-2.0
"""`sph_ros validate`: its progress, its results, its exit status."""

import os
import sys
from pathlib import Path

from tqdm import tqdm

from sph_ros.sim.abilities import LIQUID_SOLVERS
from sph_ros.validation.checks import (
    CHECKS,
    chosen,
    failures,
    run_checks,
)
from sph_ros.validation.options import ValidateError
from sph_ros.validation.report import (
    machine,
    markdown_lines,
    text_lines,
    write_csv,
    write_plots,
)
from sph_ros.waiting import preparing


def validate(options):
    """Run the checks that `options` ask for; returns the exit status."""
    if options.list:
        for name, (_, words) in CHECKS.items():
            print(f"{name:14} {words}")
        return 0
    names = chosen(options.names)
    solvers = list(LIQUID_SOLVERS) if options.solver == "all" else [options.solver]
    if solvers[0] not in LIQUID_SOLVERS:
        known = ", ".join(LIQUID_SOLVERS)
        raise ValidateError(f"--solver: expected all or one of {known}; got {options.solver!r}")
    data = None if options.data is None else _readable(options.data)
    folder = _writable(options.out)
    outcomes, complete = _run(names, solvers, options.quick, data)
    _write(folder, outcomes)
    if options.markdown:
        print(f"{machine()}; {'short form' if options.quick else 'full form'}\n")
        print("\n".join(markdown_lines(outcomes)))
    else:
        print("\n".join(text_lines(outcomes)))
        print(f"\n{machine()}\nplots and results.csv are in {folder}")
    if not complete:
        print("sph_ros validate: interrupted, what was finished is above", file=sys.stderr)
        return 130
    failed = failures(outcomes)
    if failed:
        what = ", ".join(f"{o.check} ({o.solver})" for o in failed)
        print(f"sph_ros validate: failed, and must pass: {what}", file=sys.stderr)
    return 1 if failed else 0


def _run(names, solvers, quick, data):
    """(outcomes, whether all checks were run)."""
    from sph_ros.sim.kernels import ensure_compiled, everything

    with preparing():
        ensure_compiled([name for name in everything() if name.split("+")[0] in solvers])
    outcomes = []
    bar = tqdm(total=len(names) * len(solvers), disable=None, leave=False, bar_format=_BAR)

    def tell(done, share, words):
        bar.n = round(done + share, 2)
        bar.set_description_str(words, refresh=False)
        bar.update(0)

    with bar:
        try:
            for outcome in run_checks(names, solvers, quick, data, tell):
                outcomes.append(outcome)
                bar.n = len(outcomes)
                bar.refresh()
        except KeyboardInterrupt:
            return outcomes, False
    return outcomes, True


_BAR = "{desc} {bar}| {n:.2f} of {total} checks, {elapsed} gone, {remaining} to go"


def _write(folder, outcomes):
    if outcomes:
        folder.mkdir(parents=True, exist_ok=True)
        write_csv(folder / "results.csv", outcomes)
        write_plots(folder, outcomes)


def _readable(path):
    path = Path(path)
    if not path.is_file():
        raise ValidateError(f"--data: {path}: no such file; expected one with lines T,Z")
    return path


def _writable(path):
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise ValidateError(f"--out: {path}: is a file, expected a folder to make")
    parent = path.absolute()
    while not parent.exists():
        parent = parent.parent
    if not os.access(parent, os.W_OK):
        raise ValidateError(f"--out: {path}: cannot be made, {parent} is not writable")
    return path
