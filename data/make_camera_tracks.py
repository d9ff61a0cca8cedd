"""Makes the tracks in data/camera from those in data/reference: what a camera would give.

One frame per second, Gaussian noise of 0.1 mm on positions and 0.02 rad on the head angle,
from a fixed seed. Run it from anywhere: `python data/make_camera_tracks.py`.
"""

from pathlib import Path

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
SEED = 4836
NOISE_MM = 0.1
NOISE_RAD = 0.02
RATES = (30, 70, 100)


def camera_track(reference: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """The frames of `reference` at whole seconds, in mm and rad, with noise."""
    t = reference["t"].to_numpy()
    frames = reference[np.isclose(t, np.round(t))]
    n = len(frames)
    columns = {"t": np.round(frames["t"].to_numpy())}
    for name in ("hx", "hy", "hz"):
        columns[f"{name[1]}_mm"] = 1e3 * frames[name].to_numpy() + NOISE_MM * rng.normal(size=n)
    columns["head_angle"] = frames["th0"].to_numpy() + NOISE_RAD * rng.normal(size=n)
    return pd.DataFrame(columns)


def main() -> None:
    """Write one track for every motor rate."""
    rng = np.random.default_rng(SEED)
    (HERE / "camera").mkdir(exist_ok=True)
    for rpm in RATES:
        reference = pd.read_csv(HERE / "reference" / f"single_lambda7_rpm{rpm}.csv")
        track = camera_track(reference, rng)
        text = track.to_csv(index=False, float_format="%.4f", lineterminator="\n")
        (HERE / "camera" / f"rpm{rpm}.csv").write_text(text)


if __name__ == "__main__":
    main()
