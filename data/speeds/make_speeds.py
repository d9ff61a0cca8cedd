"""Makes speeds.csv from the reference trajectories: slopes of straight lines over the last 20 s.

python data/speeds/make_speeds.py
"""

from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
RATES = (30, 70, 100)
FROM = 20.0
"""s: by then the robot swims steadily."""


def slopes(rpm: int) -> tuple[float, float]:
    """Speed along x (mm/s) and head rate (rad/s)."""
    path = HERE.parent / "reference" / f"single_lambda7_rpm{rpm}.csv"
    table = np.genfromtxt(path, delimiter=",", names=True)
    late = table["t"] > FROM
    time = table["t"][late]
    speed = np.polyfit(time, table["hx"][late], 1)[0]
    return 1e3 * float(speed), float(np.polyfit(time, table["th0"][late], 1)[0])


def main() -> None:
    rows = ["motor_rpm,v_mm_per_s,head_rate_rad_per_s"]
    for rpm in RATES:
        speed, rate = slopes(rpm)
        rows.append(f"{rpm},{speed:.6g},{rate:.6g}")
    (HERE / "speeds.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
