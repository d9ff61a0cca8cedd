"""What trackers write: one module a program, all in one list.

    sample = Sample(path)
    format = recognised(sample)
    layout = format.layout(sample)      # which column holds what, in which unit, and since when

A format of your own is one module with a `Format`, and one line in `FORMATS`.
"""

from derjax import InputError

from . import (
    imagej,
    kinovea,
    motive,
    plain,
    poses,
    tracker,
    trackmate,
    trackmate_xml,
    trackpy,
    wrong,
)
from .layout import Choice, Format, Layout, Place, Sample

FORMATS: tuple[Format, ...] = (
    *trackmate_xml.FORMATS,
    *motive.FORMATS,
    *trackmate.FORMATS,
    *poses.FORMATS,
    *kinovea.FORMATS,
    *trackpy.FORMATS,
    *tracker.FORMATS,
    *imagej.FORMATS,
    *plain.FORMATS,
)
"""All formats, in the order in which they are tried: the last takes every table."""

NAMES = tuple(one.name for one in FORMATS)
"""Values of the key `format`."""

__all__ = ["FORMATS", "NAMES", "Choice", "Format", "Layout", "Place", "Sample", "recognised"]


def recognised(sample: Sample, wanted: str | None = None) -> Format:
    """The format of a file: the one that is wanted, or the first that it fits.

    Raises:
        InputError: the file is not of the format that is wanted, or no text with tracks at all.
    """
    wrong.check(sample)
    if wanted is None:
        return next(one for one in FORMATS if one.recognise(sample))
    chosen = next(one for one in FORMATS if one.name == wanted)
    if not chosen.recognise(sample):
        fits = next(one for one in FORMATS if one.recognise(sample))
        raise InputError(
            f"{sample.path}: format = {wanted!r}: is not as {chosen.title} writes; it looks like "
            f"{fits.title} (format = {fits.name!r}); leave format out to have it found"
        )
    return chosen
