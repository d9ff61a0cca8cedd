"""Makes the files in data/formats: one track, written as each tracking program writes tables.

The track is that of data/reference/single_lambda7_rpm70.csv, one position of the head every 0.4 s.
It is seen by a camera that looks along z with pixels of 0.05 mm; in some frames nothing is found.
Run it from anywhere: `python data/make_format_files.py`.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
FPS = 2.5
PIXEL_MM = 0.05
FRAMES = 60
LOST = (17, 18, 31)
"""Frames in which nothing was found."""

CENTRE = (900.0, 512.0)
"""Pixel in which the origin of the robot's axes is seen, from the upper left corner."""


class Frame(NamedTuple):
    """One frame: its number from 0, time in s, position in mm, angle of the head in rad."""

    k: int
    t: float
    x: float
    y: float
    z: float
    angle: float

    @property
    def u(self) -> float:
        """Pixels to the right."""
        return CENTRE[0] + self.x / PIXEL_MM

    @property
    def v(self) -> float:
        """Pixels downwards."""
        return CENTRE[1] - self.y / PIXEL_MM


def frames() -> list[Frame]:
    """The track, lost frames included."""
    table = pd.read_csv(HERE / "reference" / "single_lambda7_rpm70.csv")
    rows = table[["hx", "hy", "hz", "th0"]].to_numpy()[4 : 4 + 2 * FRAMES : 2]
    return [Frame(k, round(k / FPS, 6), *(1e3 * row[:3]), row[3]) for k, row in enumerate(rows)]


def tracked() -> list[Frame]:
    """The frames in which the head was found."""
    return [frame for frame in frames() if frame.k not in LOST]


def lines(rows: Sequence[Sequence[object]], delimiter: str = ",", end: str = "\n") -> str:
    """Rows of cells as text."""
    return "".join(delimiter.join(map(str, row)) + end for row in rows)


def imagej(delimiter: str = ",") -> str:
    """Results with dust: more than one particle in some slices, rows as they were analysed."""
    rows: list[list[object]] = [[" ", "Area", "Mean", "Min", "Max", "X", "Y", "Slice"]]
    for f in tracked():
        if f.k % 7 == 3:
            rows.append([len(rows), 12, "201.250", 190, 214, "33.500", "40.250", f.k + 1])
        seen = f"{f.u:.3f}", f"{f.v:.3f}"
        rows.append([len(rows), 5200 + f.k % 3, "243.117", 201, 255, *seen, f.k + 1])
    return lines(rows, delimiter)


def imagej_labels() -> str:
    """Results in mm with a scale, where only the labels tell the slices."""
    rows: list[list[object]] = [[" ", "Label", "Area", "X", "Y", "Major", "Minor", "Angle"]]
    for f in tracked():
        seen = f"{f.u * PIXEL_MM:.5f}", f"{f.v * PIXEL_MM:.5f}"
        angle = math.degrees(f.angle) % 180.0
        label = f"film.avi:{f.k + 1:04d}"
        rows.append([len(rows), label, "13.021", *seen, "4.211", "3.937", f"{angle:.3f}"])
    return lines(rows, "\t")


def manual_tracking() -> str:
    """The plugin Manual Tracking: whole pixels in life, here with digits."""
    head = ["Track n\N{DEGREE SIGN}", "Slice n\N{DEGREE SIGN}"]
    rows: list[list[object]] = [[*head, "X", "Y", "Distance", "Velocity", "Pixel Value"]]
    for f in tracked():
        rows.append([1, f.k + 1, f"{f.u:.3f}", f"{f.v:.3f}", "-1.000", "-1.000", 255])
    return lines(rows, "\t")


def mtrackj() -> str:
    """The plugin MTrackJ, with its units in the header."""
    rows: list[list[object]] = [
        ["Nr", "TID", "PID", "x [mm]", "y [mm]", "t [sec]", "I [val]", "Len [mm]", "D2S [mm]"]
    ]
    for f in tracked():
        seen = f"{f.u * PIXEL_MM:.5f}", f"{f.v * PIXEL_MM:.5f}"
        rows.append([len(rows), 1, len(rows), *seen, f"{f.t:.3f}", 255, "NA", "NA"])
    return lines(rows, "\t")


SPOTS = (
    "LABEL ID TRACK_ID QUALITY POSITION_X POSITION_Y POSITION_Z POSITION_T FRAME RADIUS VISIBILITY"
)


def _spots(scale: float) -> Iterator[list[object]]:
    """Rows of spots in no order, with one spot that belongs to no track."""
    order = np.random.default_rng(7).permutation(len(tracked()))
    for i in order:
        f = tracked()[i]
        seen = f"{f.u * scale:.5f}", f"{f.v * scale:.5f}"
        yield [f"ID{100 + f.k}", 100 + f.k, 0, "31.25", *seen, "0.0", f.t, f.k, "3.5", 1]
    yield ["ID999", 999, "", "2.5", "1.25", "1.5", "0.0", "4.0", 10, "3.5", 1]


def trackmate() -> str:
    """The table of spots, with four header rows."""
    names = "Label,Spot ID,Track ID,Quality,X,Y,Z,T,Frame,{},Visibility"
    units = ",,,(quality),(mm),(mm),(mm),(sec),,(mm),"
    head = [SPOTS.replace(" ", ","), names.format("Radius"), names.format("R"), units]
    return "\n".join(head) + "\n" + lines(list(_spots(PIXEL_MM)))


def trackmate_old() -> str:
    """The older "Spots in tracks statistics" of a film without calibration."""
    rows: list[list[object]] = [[" ", "Label", *SPOTS.split()[1:]]]
    for row in _spots(1.0):
        if row[2] != "":
            rows.append([len(rows), *row[:7], row[8], *row[8:]])  # POSITION_T is the frame
    return lines(rows)


def trackmate_xml() -> str:
    """Tracks as XML."""
    found = tracked()
    about = (
        f'<Tracks nTracks="1" spaceUnits="mm" frameInterval="{1 / FPS}" timeUnits="sec" '
        'generationDateTime="Fri, 2 May 2025 10:30:12" from="TrackMate v7.11.1">\n'
    )
    rows = "".join(
        f'    <detection t="{f.k}" x="{f.u * PIXEL_MM:.6f}" y="{f.v * PIXEL_MM:.6f}" z="0.0" />\n'
        for f in found
    )
    particle = f'  <particle nSpots="{len(found)}">\n{rows}  </particle>\n'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{about}{particle}</Tracks>\n'


def _tracker_number(value: float) -> str:
    return f"{value:.6E}".replace("E-0", "E-").replace("E+0", "E").replace(".", ",")


def tracker() -> str:
    """Tracker in a country with decimal commas: lost points are empty, delimiters at the ends."""
    rows: list[list[object]] = [["mass_A", "", "", ""], ["t", "x", "y", ""]]
    for f in frames():
        seen = ["", ""] if f.k in LOST else [_tracker_number(f.x), _tracker_number(f.y)]
        rows.append([_tracker_number(f.t), *seen, ""])
    return lines(rows, "\t")


def tracker_multi() -> str:
    """Tracker with two masses side by side."""
    rows: list[list[object]] = [
        ["head", "", "", "tail", "", "", ""],
        ["t", "x", "y", "t", "x", "y", ""],
    ]
    for f in frames():
        seen = ["", ""] if f.k in LOST else [f"{f.x:.6E}", f"{f.y:.6E}"]
        rows.append([f"{f.t:.6E}", *seen, f"{f.t:.6E}", f"{f.x + 110:.6E}", f"{-f.y:.6E}", ""])
    return "#multi:\n" + lines(rows, ";")


def kinovea() -> str:
    """Kinovea with decimal commas: every cell quoted."""
    rows: list[list[object]] = [["Time", "Track 1/0/X", "Track 1/0/Y"]]
    rows += [[f"{f.t:.4f}", f"{f.x:.4f}", f"{f.y:.4f}"] for f in tracked()]
    return lines([[f'"{cell}"'.replace(".", ",") for cell in map(str, row)] for row in rows], ";")


def kinovea_old() -> str:
    """Kinovea with times of a clock, which end with hundredths of a second."""
    rows: list[list[object]] = [["Time", "Track 1/0/X", "Track 1/0/Y"]]
    for f in tracked():
        clock = f"0:00:{int(f.t):02d}:{round(100 * (f.t % 1)):02d}"
        rows.append([clock, f"{f.x:.4f}", f"{f.y:.4f}"])
    return lines([[f'"{cell}"' for cell in row] for row in rows])


SCORER = "DLC_resnet50_swimmerMay2shuffle1_100000"


def deeplabcut(individuals: bool = False) -> str:
    """DeepLabCut: two points of the robot; a lost one has a place, and a small likelihood."""
    parts = ["head"] * 3 + ["tail"] * 3
    rows: list[list[object]] = [["scorer", *[SCORER] * 6]]
    if individuals:
        rows.append(["individuals", *["swimmer"] * 6])
    rows += [["bodyparts", *parts], ["coords", *["x", "y", "likelihood"] * 2]]
    for f in frames():
        head = [f"{f.u:.4f}", f"{f.v:.4f}", "0.9987"]
        if f.k in LOST:
            head = ["1411.2", "3.71", "0.0312"]
        rows.append([f.k, *head, f"{f.u + 2200:.4f}", f"{f.v:.4f}", "0.9712"])
    return lines(rows)


def sleap() -> str:
    """SLEAP's analysis as CSV: empty cells where a point was not found."""
    rows: list[list[object]] = [
        ["track", "frame_idx", "instance.score"]
        + [f"{node}.{one}" for node in ("head", "tail") for one in ("x", "y", "score")]
    ]
    for f in frames():
        head = ["", "", ""] if f.k in LOST else [f"{f.u:.4f}", f"{f.v:.4f}", "0.94"]
        rows.append(["track_0", f.k, "0.91", *head, f"{f.u + 2200:.4f}", f"{f.v:.4f}", "0.88"])
    return lines(rows)


def trackpy() -> str:
    """trackpy, as pandas saves it: an index without a name, y before x."""
    head = ["", "y", "x", "mass", "size", "ecc", "signal", "raw_mass", "ep", "frame", "particle"]
    rows: list[list[object]] = [head]
    for k, f in enumerate(tracked()):
        rest = ["2141.3", "3.21", "0.041", "53.2", "2730.0", "0.012"]
        rows.append([k, f"{f.v:.5f}", f"{f.u:.5f}", *rest, f.k, 0])
    return lines(rows)


def _quaternion(angle: float) -> list[float]:
    """x, y, z, w of a turn by `angle` about x, of a body that was mounted askew."""
    turn = np.array([math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2)])
    askew = np.array([0.1, -0.2, 0.3, math.sqrt(1 - 0.14)])
    vector = turn[3] * askew[:3] + askew[3] * turn[:3] + np.cross(turn[:3], askew[:3])
    return [*vector, float(turn[3] * askew[3] - turn[:3] @ askew[:3])]


def motive() -> str:
    """OptiTrack Motive: a rigid body, whose cells are empty where it was occluded."""
    about = (
        "Format Version,1.23,Take Name,swim,Take Notes,,Capture Frame Rate,2.500000,"
        "Export Frame Rate,2.500000,Capture Start Time,2025-05-02 10.30.12.123 AM,"
        f"Total Frames in Take,{FRAMES},Total Exported Frames,{FRAMES},Rotation Type,Quaternion,"
        "Length Units,Meters,Coordinate Space,Global"
    )
    head: list[list[object]] = [
        ["", "", *["Rigid Body"] * 8],
        ["", "", *["Robot"] * 8],
        ["", "", *['"6CF9F5C0A9B811EA5CA6A0481C89C2CB"'] * 8],
        ["", "", *["Rotation"] * 4, *["Position"] * 3, "Mean Marker Error"],
        ["Frame", "Time (Seconds)", "X", "Y", "Z", "W", "X", "Y", "Z", ""],
    ]
    for f in frames():
        row: list[object] = [f.k, f"{f.t:.6f}"]
        cells = [*_quaternion(f.angle), 1e-3 * f.x, 1e-3 * f.y, 1e-3 * f.z, 3e-4]
        row += [""] * 8 if f.k in LOST else [f"{cell:.8f}" for cell in cells]
        head.append(row)
    return about + "\n\n" + lines(head)


def plain() -> str:
    """A table as one types or saves it."""
    rows: list[list[object]] = [["time (s)", "x (mm)", "y (mm)", "z (mm)", "head_angle (deg)"]]
    for f in frames():
        cells = [f.x, f.y, f.z, math.degrees(f.angle)]
        rows.append([f.t, *("NaN" if f.k in LOST else f"{cell:.5f}" for cell in cells)])
    return lines(rows)


FILES = {
    "imagej.csv": (imagej(), "utf-8"),
    "imagej_tabs.txt": (imagej("\t"), "cp1252"),
    "imagej_labels.tsv": (imagej_labels(), "utf-8"),
    "manual_tracking.xls": (manual_tracking(), "cp1252"),
    "mtrackj.txt": (mtrackj(), "utf-8"),
    "trackmate.csv": (trackmate(), "utf-8"),
    "trackmate_old.csv": (trackmate_old(), "utf-8"),
    "trackmate.xml": (trackmate_xml(), "utf-8"),
    "tracker.txt": (tracker(), "utf-16"),
    "tracker_multi.txt": (tracker_multi(), "utf-8"),
    "kinovea.csv": (kinovea(), "utf-8-sig"),
    "kinovea_old.csv": (kinovea_old(), "utf-8-sig"),
    "deeplabcut.csv": (deeplabcut(), "utf-8"),
    "deeplabcut_individuals.csv": (deeplabcut(individuals=True), "utf-8"),
    "sleap.csv": (sleap(), "utf-8"),
    "trackpy.csv": (trackpy(), "utf-8"),
    "motive.csv": (motive(), "utf-8"),
    "plain.csv": (plain(), "utf-8"),
}
"""The text and the encoding of every file."""


def main() -> None:
    """Write all files."""
    (HERE / "formats").mkdir(exist_ok=True)
    for name, (text, encoding) in FILES.items():
        (HERE / "formats" / name).write_bytes(text.encode(encoding))


if __name__ == "__main__":
    main()
