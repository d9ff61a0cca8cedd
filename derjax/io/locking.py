"""A lock on a directory, so that two programs do not write their results into one."""

import json
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..core.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".derjax.lock"
"""Name of the file that says who writes into a directory."""


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps other programs out of a directory that exists.

    A lock that was left by a program which has ended on this machine is taken over.

    Raises:
        InputError: another program writes there; the message says which.
        OSError: the lock cannot be written.
    """
    path = directory / LOCK
    descriptor = _acquire(path)
    try:
        os.ftruncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, json.dumps({"host": platform.node(), "pid": os.getpid()}).encode())
        yield
    finally:
        os.ftruncate(descriptor, 0)  # where open files cannot be removed, nobody is named
        with suppress(OSError):
            path.unlink(missing_ok=True)
        os.close(descriptor)


def _acquire(path: Path) -> int:
    """An open file that holds the lock.

    The kernel gives a lock back when its holder ends, however that happens. It knows of other
    machines on some network file systems only, so the name of the machine counts as well.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            free = _try(descriptor)
            holder = _holder(descriptor)
            here = holder.get("host", platform.node()) == platform.node()
            if not (free and here):
                raise InputError(_refusal(path, holder, here))
            with suppress(FileNotFoundError):
                if os.fstat(descriptor).st_ino == path.stat().st_ino:
                    return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder removed the file before letting go of it


def _try(descriptor: int) -> bool:
    """Whether a file could be locked; without such locks, whether nobody is named in it."""
    if fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            pass
    return not _holder(descriptor)


def _holder(descriptor: int) -> dict[str, Any]:
    """Who is named in the file of a lock; nobody while it is being written."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    try:
        holder = json.loads(os.read(descriptor, 4096))
    except ValueError:
        return {}
    return holder if isinstance(holder, dict) else {}


def _refusal(path: Path, holder: dict[str, Any], here: bool) -> str:
    who = f"process {holder.get('pid', '?')} on {holder.get('host', platform.node())}"
    said = f"{path.parent}: {who} writes its results there; choose another directory, or wait"
    return said if here and fcntl is not None else f"{said}; if it has ended, delete {path}"
