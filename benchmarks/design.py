"""Designs by gradients: optima that are known, softness, contact, cost, programmes of the motor.

    python -m benchmarks.design [-o docs/figures] [--only PART]

writes design.md, and a table and figures of each part; with `--only` the other parts of design.md
stay as they are. Parts: rigid, helices, softness, contact, cost, programme.
"""

from collections.abc import Callable
from pathlib import Path

from .command import command_line
from .design_cost import cost, programme
from .design_rigid import helices, swimmers
from .design_softness import contact, softness

PARTS: dict[str, tuple[str, Callable[[Path], str]]] = {
    "rigid": ("Rigid robots", swimmers),
    "helices": ("Rigid helices", helices),
    "softness": ("Softness", softness),
    "contact": ("Two flagella, through contact", contact),
    "cost": ("Cost of a design", cost),
    "programme": ("A programme of the motor", programme),
}
"""Title, and what makes tables and figures in a directory and says what was found."""

HEADING = (
    "# Design by gradients\n\n`python -m benchmarks.design`: SI units. Wall times are as long as "
    "the machine, two cores, took with whatever else it did; processor times leave that out.\n"
)


def sections(path: Path) -> dict[str, str]:
    """What a file has under each title."""
    if not path.is_file():
        return {}
    parts = path.read_text(encoding="utf-8").split("\n## ")[1:]
    return {title: text.strip() for title, _, text in (part.partition("\n") for part in parts)}


def main() -> None:
    """Make the parts."""
    parser = command_line(__doc__)
    parser.add_argument("--only", choices=list(PARTS), action="append", metavar="PART")
    arguments = parser.parse_args()
    path = arguments.output / "design.md"
    for name in arguments.only or PARTS:
        title, part = PARTS[name]
        text = part(arguments.output).strip()
        print(f"## {title}\n\n{text}\n", flush=True)
        known = sections(path) | {title: text}
        every = [f"\n## {t}\n\n{known[t]}\n" for t, _ in PARTS.values() if t in known]
        path.write_text(HEADING + "".join(every), encoding="utf-8")


if __name__ == "__main__":
    main()
