"""Results of a benchmark as a file for programs and one to read."""

from collections.abc import Mapping
from pathlib import Path

import pandas as pd


def markdown(table: pd.DataFrame, formats: Mapping[str, str]) -> str:
    """The columns of `formats` as a table in Markdown; nothing is written where a value is missing.

    Args:
        table: one row for each result.
        formats: columns to be read by people, and how their numbers are written.
    """
    rows = ["| " + " | ".join(formats) + " |", "|---" * len(formats) + "|"]
    for row in table.to_dict("records"):
        cells = ["" if pd.isna(row[c]) else format(row[c], f) for c, f in formats.items()]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows) + "\n"


def write(table: pd.DataFrame, path: Path, formats: Mapping[str, str], note: str = "") -> None:
    """Writes `path` as CSV, and beside it, as Markdown, the columns of `formats`.

    Args:
        table: one row for each result.
        path: ends in .csv.
        formats: columns to be read by people, and how their numbers are written.
        note: Markdown that goes above the table.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False, float_format="%.6g")
    text = (note + "\n\n" if note else "") + markdown(table, formats)
    path.with_suffix(".md").write_text(text, encoding="utf-8")
