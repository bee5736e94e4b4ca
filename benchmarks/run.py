# SPDX-License-Identifier: Apache-2.0
"""All benchmarks, one after the other: a table of results and a plot, with facts of the machine.

    python benchmarks/run.py [NAMES] [--out out/bench]

Each benchmark can be run alone, too: python benchmarks/bench_NAME.py --help.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from sph_ros.validation.report import machine

HERE = Path(__file__).parent

#: More arguments of some benchmarks; {out} is the folder of the results.
MORE = {"dam_break": ["--plot", "{out}/dam_break.png"]}


def names():
    """Of all benchmarks."""
    return sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py"))


def run(name, out):
    """Run one and pass on what it prints; returns its output and whether it went well."""
    more = [word.format(out=out) for word in MORE.get(name, [])]
    command = [sys.executable, str(HERE / f"bench_{name}.py"), *more]
    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    return "".join(lines), process.returncode == 0


def main():
    """Run those asked for; the exit status is 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAMES", help=f"of {', '.join(names())}")
    parser.add_argument("--out", default="out/bench", help="folder of the results (out/bench)")
    options = parser.parse_args()
    unknown = set(options.names) - set(names())
    if unknown:
        parser.error(f"no benchmark {unknown.pop()!r}; known: {', '.join(names())}")
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    failed = []
    with open(out / "results.md", "w", encoding="utf-8") as report:
        print(f"# {machine()}", file=report, flush=True)
        for name in options.names or names():
            print(f"== {name}", flush=True)
            text, went_well = run(name, out)
            print(f"\n## {name}\n\n```\n{text}```", file=report, flush=True)
            if not went_well:
                failed.append(name)
    print(f"results and plot are in {out}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
