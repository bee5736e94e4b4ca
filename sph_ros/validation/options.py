# SPDX-License-Identifier: Apache-2.0
"""Options of `sph_ros validate`; what it needs to run is imported when it runs."""

#: Solvers that have to pass every check.
REQUIRED = ("incompressible",)


class ValidateError(ValueError):
    """The checks cannot start; one line that says why."""


def add_validate(commands):
    """The subcommand's options."""
    parser = commands.add_parser(
        "validate",
        help="measure the solvers against known physics",
        description="Run physical tests with a known truth and print truth, measured and error. "
        f"Exit status 1 if a test of {' or '.join(REQUIRED)} fails; the others are only told.",
    )
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="checks to run; default: all, see --list")
    add("--list", action="store_true", help="name all checks and stop")
    add("--solver", default="all", metavar="SOLVER", help="name of a solver, or all (default)")
    add("--quick", action="store_true", help="the short form: fewer particles, shorter times")
    add("--out", metavar="DIR", default="out/validate", help="for plots (default: out/validate)")
    add("--data", metavar="FILE", help="published points T,Z of a dam break, instead of a curve")
    add("--markdown", action="store_true", help="print the table of the README")
    parser.set_defaults(run=_validate)


def _validate(options):
    from sph_ros.validation.command import validate

    return validate(options)
