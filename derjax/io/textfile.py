"""Text files of any origin: which encoding they are in, and what they are if they are no text."""

import codecs
from pathlib import Path
from typing import BinaryIO

from ..core.errors import InputError

MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
"""Encodings by the byte-order mark that a file begins with."""

BINARY = {
    b"PK\x03\x04": "a workbook or an archive",
    b"\xd0\xcf\x11\xe0": "a workbook",
    b"\x89HDF": "an HDF5 file",
    b"%PDF": "a PDF",
    b"\x1f\x8b": "a compressed file",
    b"\x89PNG": "a picture (PNG)",
    b"\xff\xd8\xff": "a picture (JPEG)",
    b"II*\0": "a picture (TIFF)",
    b"MM\0*": "a picture (TIFF)",
    b"RIFF": "a film (AVI)",
    b"\x1aE\xdf\xa3": "a film (Matroska)",
    b"Iout": "a region of ImageJ",
}
"""Files that are often taken for text, by their first bytes."""

ADVICE = "export it as text (CSV)"

LEGACY = ("cp1252", "latin-1")
"""What is assumed of text that is not UTF-8 and has no mark; the second fits any bytes."""

PIECE = 1 << 20


def encoding_of(path: Path) -> str:
    """The name of the encoding of a text file, for `open`.

    A byte-order mark says what it is; else it is UTF-8 if it can be, and else one of `LEGACY`,
    in which Western versions of Windows save.

    Raises:
        InputError: there is no such file, it cannot be read, or it is not text.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
            for first, kind in BINARY.items():
                if head.startswith(first):
                    raise InputError(f"{path}: is {kind}, not text; {ADVICE}")
            if head[4:8] == b"ftyp":
                raise InputError(f"{path}: is a film (MP4), not text; {ADVICE}")
            for mark, name in MARKS.items():
                if head.startswith(mark):
                    return name
            if b"\0" in head:
                return _without_mark(path, head)
            stream.seek(0)
            for name in ("utf-8", LEGACY[0]):
                if _fits(stream, name):
                    return name
            return LEGACY[1]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_text(path: Path) -> str:
    """The whole of a text file in any encoding, with line ends as they are.

    Raises:
        InputError: as `encoding_of` does.
    """
    encoding = encoding_of(path)
    try:
        return path.read_bytes().decode(encoding)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None


def _without_mark(path: Path, head: bytes) -> str:
    """UTF-16 whose mark is missing: every second byte of Western text is zero."""
    half = len(head) // 2
    for first, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        if head[first::2].count(0) > 0.8 * half and not head[1 - first :: 2].count(0):
            return name
    raise InputError(f"{path}: is not text")


def _fits(stream: BinaryIO, encoding: str) -> bool:
    """Whether all of a stream is of some encoding."""
    stream.seek(0)
    decoder = codecs.getincrementaldecoder(encoding)()
    try:
        while piece := stream.read(PIECE):
            decoder.decode(piece)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True
