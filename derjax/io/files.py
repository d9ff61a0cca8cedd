"""Writing files so that a reader never meets half of one."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.errors import InputError

BLOCK = 4096
"""Bytes by which it is tried out whether a directory can be written to."""

_HDF5 = re.compile(r"errno = (\d+)")


class WriteError(OSError):
    """A file could not be written; the message names it and the cause."""

    def __str__(self) -> str:
        return f"{self.filename}: cannot be written: {self.strerror}"


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, with its suffix, that is renamed to `path` on success.

    If the block raises, `path` is as it was before and the temporary file is gone.

    Raises:
        WriteError: the directory of `path` does not exist, cannot be written to, or is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}-{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except Exception as error:
        if (cause := _cause(error, temporary)) is None:
            raise
        raise WriteError(*cause, str(path)) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _cause(error: Exception, temporary: Path) -> tuple[int | None, str] | None:
    """Why `temporary` could not be written: number and words; None if `error` is another one."""
    if match := _HDF5.search(str(error)):  # HDF5 raises exceptions of several kinds
        return int(match[1]), os.strerror(int(match[1]))
    if not isinstance(error, OSError) or error.filename not in (None, str(temporary), temporary):
        return None
    return error.errno, error.strerror or str(error)


def writable_directory(path: Path) -> None:
    """Makes a directory, with those above it, and tries out that files can be written there.

    Raises:
        InputError: it is something else, cannot be made, or cannot be written to.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is not a directory (--output)")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made: {error.strerror}") from None
    trial = path / f".derjax-{os.getpid()}"
    try:
        with trial.open("wb") as stream:
            stream.write(bytes(BLOCK))
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise InputError(f"{path}: cannot be written to: {error.strerror}") from None
    finally:
        with suppress(OSError):
            trial.unlink(missing_ok=True)


def make_room(path: Path, size: int) -> None:
    """Makes sure that a file of `size` bytes fits, for libraries that end badly if it does not.

    Raises:
        OSError: it does not.
    """
    if hasattr(os, "posix_fallocate"):
        with path.open("wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, size)
    elif shutil.disk_usage(path.parent).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
