"""Makes docs/gallery.md and docs/gallery/*.png from the executed notebooks.

    python docs/make_gallery.py

Of each notebook it takes the title, the first sentences, and one picture: that of the first cell
with the tag "gallery", or else the last picture. To choose, write `# %% tags=["gallery"]` above a
cell.
"""

import base64
import re
import textwrap
from pathlib import Path

import nbformat
from nbformat import NotebookNode

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = ROOT / "docs" / "gallery"

SENTENCES = 2
"""How many of a notebook's first sentences are shown."""

HEAD = """# Gallery

The notebooks, each with one of its pictures. A notebook takes about a minute, most of it for
compiling, and checks its own numbers. `python docs/make_gallery.py` makes this page from the
executed copies.
"""


def picture(notebook: NotebookNode) -> bytes:
    """The PNG that stands for a notebook.

    Raises:
        ValueError: it has no picture.
    """
    found = [
        ("gallery" in cell.metadata.get("tags", []), output.data["image/png"])
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "image/png" in output.get("data", {})
    ]
    if not found:
        raise ValueError("no picture in any output: execute the notebook first")
    chosen = [png for tagged, png in found if tagged]
    return base64.b64decode(chosen[0] if chosen else found[-1][1])


def description(notebook: NotebookNode) -> tuple[str, str]:
    """The title of a notebook and its first sentences."""
    first = next(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    title, paragraph, *_ = first.split("\n\n")
    sentences = re.split(r"(?<=[.?!])\s+", paragraph)
    text = " ".join(" ".join(sentences[:SENTENCES]).split())
    if text.endswith(":"):
        text = text[:-1] + "."
    return title.removeprefix("# ").strip(), "\n".join(textwrap.wrap(text, 110))


def page(notebooks: dict[str, NotebookNode]) -> str:
    """The gallery as Markdown, of notebooks by the stems of their files."""
    parts = [HEAD]
    for stem, notebook in notebooks.items():
        title, text = description(notebook)
        link = f"../notebooks/{stem}.ipynb"
        parts.append(
            f"## [{title}]({link})\n\n{text}\n\n[![{title}](gallery/{stem}.png)]({link})\n"
        )
    return "\n".join(parts)


def read() -> dict[str, NotebookNode]:
    """The executed notebooks by stem, in order."""
    paths = sorted(NOTEBOOKS.glob("*.ipynb"))
    return {path.stem: nbformat.read(path, as_version=4) for path in paths}


def main() -> None:
    """Write the page and its pictures; pictures of notebooks that are gone are removed."""
    notebooks = read()
    PICTURES.mkdir(exist_ok=True)
    for old in PICTURES.glob("*.png"):
        if old.stem not in notebooks:
            old.unlink()
    for stem, notebook in notebooks.items():
        (PICTURES / f"{stem}.png").write_bytes(picture(notebook))
    PAGE.write_text(page(notebooks), encoding="utf-8")


if __name__ == "__main__":
    main()
