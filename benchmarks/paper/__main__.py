"""The claims of the paper on two flagella, one by one, each with the runs that judge it.

    python -m benchmarks.paper [-o docs/figures] [--runs runs/paper] [--quick] [--made]
                              [--only STUDY ...]

Lim, Yadunandan & Jawed, Soft Matter 19, 2254, 2023. Studies are

- pairs: two flagella in phase and in antiphase, pitch over radius 5, 7, 9 at 30 to 70 rpm, and at
  50 rpm in phase with one thing changed (regularization, separation, friction, hinge, motors);
- single: steady states of one flagellum, omega_bar of 10 to 400;
- unbundling: motors of a little different rates, by mismatch, friction, separation, kind of motor;
- synchrony: two motors of limited torque that start out of phase, by stiffness;
- wrapping: filaments on fixed motors, at a viscous-elastic number 20 times that of the robot;
- winding: two of these at lower rates, against a local model of crossing and wrapping.

Every run is kept in a file of its own and not made again, so that the study can be stopped and goes
on; `--made` judges by those that are there. Writes paper.md, in which the parts of other studies
stay, and paper_*.png. `--quick` has fewer and shorter runs, takes minutes, and writes into a folder
`quick` of its own.
"""

import re
from pathlib import Path

from ..command import command_line
from . import studies
from .pages import STUDIES
from .runs import Case, Result, results_of

SHORT = "Runs are so short here that transients count: verdicts may be others than of the whole."

MARK = "<!-- study: {} -->"
"""What stands before the part of a study in the page."""


def parts_of(page: Path) -> dict[str, str]:
    """What a page says already, by study."""
    if not page.exists():
        return {}
    _, *rest = re.split(MARK.format(r"(\w+)") + r"\n+", page.read_text(encoding="utf-8"))
    return {name: text.rstrip() + "\n" for name, text in zip(rest[::2], rest[1::2], strict=True)}


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--runs", type=Path, default=Path("runs/paper"), help="where runs are kept")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs")
    parser.add_argument("--only", nargs="+", choices=STUDIES, help="studies to make")
    parser.add_argument("--made", action="store_true", help="judge by the runs that are there")
    arguments = parser.parse_args()
    length = studies.QUICK if arguments.quick else studies.WHOLE
    runs = arguments.runs / ("quick" if arguments.quick else "whole")

    missing: list[str] = []

    def found(cases: list[Case]) -> dict[str, Result]:
        results = results_of(cases, runs, make=not arguments.made)
        missing.extend(case.name for case in cases if case.name not in results)
        return results

    output = arguments.output / "quick" if arguments.quick else arguments.output
    output.mkdir(parents=True, exist_ok=True)
    page = output / "paper.md"
    parts = parts_of(page)
    for name, study in STUDIES.items():
        if arguments.only is None or name in arguments.only:
            missing.clear()
            parts[name] = study(length, found, output)
            if missing:
                parts[name] += f"\nNot made yet, and not judged: {len(missing)} runs.\n"
            print(parts[name], flush=True)
            command = "python -m benchmarks.paper" + " --quick" * arguments.quick
            text = f"# The paper, claim by claim\n\n`{command}`\n"
            text += f"\n{SHORT}\n" * arguments.quick
            text += "".join(f"\n{MARK.format(n)}\n\n{parts[n]}" for n in STUDIES if n in parts)
            page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
