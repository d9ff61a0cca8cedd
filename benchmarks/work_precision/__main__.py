"""How large the error of a run is, and what it costs, for every way of stepping in time.

    python -m benchmarks.work_precision [-o DIR] [--quick] [--only single|two] [--rounds 3]
                                        [--cache DIR] [--before CSV]

Runs the robot with one flagellum (pitch / radius = 7, 60 rpm, 20 s) and that with two (pitch /
radius = 5, antiphase, 60 rpm, 10 s, with contact) with every scheme, in steps of several lengths
and in steps that adapt at several tolerances, with Stokeslet segments (RSS) and local drag (RFT),
on several meshes, and with explicit drag in steps of 0.1 ms. The speed v_x and the head rate are
those that `derjax simulate` writes, over the second half of a run; the nodes of the helices are
compared in every frame (0.1 s), in units of the helix radius R.

The error in time is against TR-BDF2 in steps of 1/1280 s on the same mesh; the whole error is
against that on the finest mesh. The cost is processor time for a simulated second, without
compilation, the least of several rounds over all runs in turn (long runs are timed once). Results
are kept in a directory of temporary files that is named after the contents of derjax, so that a
benchmark that was stopped goes on where it was; `--cache` names another one. `--before` names the
table of all runs that another version of derjax has written, best beside this one on the same
machine: its runs are shown in grey, and kept as work_precision_before.csv.

The order in the length of the steps is measured apart, over one turn of the motor from a developed
state: over 20 s from rest, steps that are small enough for it would be too costly.

Writes work_precision.csv (all runs), .md and .png, work_precision_mesh.png, work_precision_two.png,
work_precision_order.csv and .png.
"""

import hashlib
import tempfile
from pathlib import Path

import pandas as pd

import derjax

from ..command import command_line
from ..tables import markdown
from .figures import draw, draw_meshes, draw_orders
from .results import COLUMNS, across_meshes, by_mesh, chosen, findings, fitted, row
from .runs import Runs, orders
from .settings import CASES, MESH_TOLERANCE, settings

ROUNDS = 3
"""Of timing."""


def write(
    table: pd.DataFrame, fine: pd.DataFrame | None, before: pd.DataFrame | None, output: Path
) -> None:
    """All files."""
    table.to_csv(output / "work_precision.csv", index=False, float_format="%.6g")
    parts = [findings(table, before)] if "single" in set(table.case) else []
    best = chosen(table, before)
    parts.append(markdown(best, {c: how for c, how in COLUMNS.items() if c in best}))
    parts.append("Orders of convergence, fitted over a range of steps or of edges:")
    formats = {"of": "", "quantity": "", "range": "", "order": ".2f"}
    parts.append(markdown(fitted(table, fine), formats))
    meshes = by_mesh(table)
    if len(meshes) > 1:
        parts.append(
            f"Meshes, with implicit Euler at a tolerance of {MESH_TOLERANCE:g}, which adds the "
            "same error on all of them. Shaft and links of the head are as long as an edge, so "
            "that a robot of a finer mesh is also a slightly shorter one:"
        )
        texts = ("robot", "drag")
        parts.append(markdown(meshes, {c: "" if c in texts else ".3f" for c in meshes}))
    if (table[table.case == "single"].groupby("scheme").mesh.nunique() > 1).any():
        across = across_meshes(table)
        parts.append(
            "The same setting on several meshes, one flagellum: the worse of the errors of speed "
            "and head rate against the finest steps on that mesh, and the cost of a second:"
        )
        texts = ("drag", "setting")
        parts.append(markdown(across, {c: "" if c in texts else ".3g" for c in across}))
    text = "\n\n".join(part.strip() for part in parts) + "\n"
    (output / "work_precision.md").write_text(text, encoding="utf-8")
    if "single" in set(table.case):
        draw(table, before, "single").savefig(output / "work_precision.png", dpi=150)
        if len(set(table.mesh)) > 2:
            draw_meshes(table).savefig(output / "work_precision_mesh.png", dpi=150)
    if "two" in set(table.case):
        draw(table, before, "two").savefig(output / "work_precision_two.png", dpi=150)
    if fine is not None:
        fine.to_csv(output / "work_precision_order.csv", index=False, float_format="%.6g")
        draw_orders(fine).savefig(output / "work_precision_order.png", dpi=150)
    print(text)


def contents() -> str:
    """A few digits that change with the sources of derjax."""
    digest = hashlib.sha256()
    for path in sorted(Path(derjax.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--quick", action="store_true", help="few runs: RSS, one mesh")
    parser.add_argument("--only", choices=list(CASES), help="this robot only")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of timing")
    parser.add_argument("--cache", type=Path, help="where runs are kept")
    parser.add_argument("--before", type=Path, help="table of another version's runs")
    arguments = parser.parse_args()
    before = None
    if arguments.before:
        before = pd.read_csv(arguments.before).fillna({"message": ""})
    kept = Path(tempfile.gettempdir()) / f"derjax_work_precision_{contents()}"
    runs = Runs(arguments.cache or kept)
    cases = [arguments.only] if arguments.only else list(CASES)
    wanted = [setting for case in cases for setting in settings(case, arguments.quick)]
    for setting in wanted:
        runs.make(setting)
    for _ in range(1, arguments.rounds):
        for setting in wanted:
            runs.again(setting, arguments.rounds)
    table = pd.DataFrame([row(runs, setting) for setting in wanted])
    kept_orders = runs.directory / f"orders{'-quick' if arguments.quick else ''}.csv"
    if not kept_orders.exists():
        orders(arguments.quick).to_csv(kept_orders, index=False)
    if before is not None:
        kept_before = arguments.output / "work_precision_before.csv"
        before.to_csv(kept_before, index=False, float_format="%.6g")
    write(table, pd.read_csv(kept_orders), before, arguments.output)


if __name__ == "__main__":
    main()
