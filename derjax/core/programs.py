"""Traced programs that are kept on disk: the next process need not trace them again.

    march = stored(march_frames, static=(2, 3))  # for jax.jit(march_frames, static_argnums=(2, 3))

JAX keeps compiled programs, but looks for them by what it has traced, and tracing takes longer than
all else that a process does before its first step. So a program is exported (`jax.export`:
StableHLO, before it is compiled) and found again by all that it follows from: the sources of derjax
and of the package of the function, versions and settings of JAX, the kind of device, and the
arguments: of static ones the values, of others structure, shapes and types. Numbers in leaves are
no part of it.

What that list does not describe for certain is traced as ever: functions, classes and objects of
other packages, such as the terms of extensions; sources that have been changed since this process
began; devices other than the first. A file that is damaged, or is no program of derjax, is
replaced. Nothing is kept before `keep_in` has been called, and a directory that cannot be written
to costs no more than the time of tracing. Whoever may write to it can have any code run, as with
JAX's own directory of compiled programs.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.sharding import SingleDeviceSharding

from .fingerprint import Unknown, described, leaves_described

BEGAN = time.time() - 2.0
"""Sources that are younger (s since the epoch) may not be those that this process has imported."""

MAGIC = b"derjax program 1\n"
MOST_BYTES = 512 * 2**20
"""Of the files in a directory; those that have not been used for longest go first."""

NO_MATTER = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_debug_log")
"""Beginnings of the names of settings that change no program: what is kept, and what is told."""

_directory: Path | None = None


def keep_in(directory: Path | None) -> None:
    """Keep programs in this directory from now on; None: nowhere."""
    global _directory
    _directory = directory


class _Program(NamedTuple):
    """A program of flat lists of arrays.

    Attributes:
        call: the leaves of the arguments to those of the result; may be compiled.
        result: structure of the result.
    """

    call: Any
    result: Any


class Stored:
    """A function that JAX compiles, whose programs are kept.

    Attributes:
        jitted: the same by `jax.jit` alone, which is also what transformations of JAX go through.
    """

    def __init__(self, function: Callable[..., Any], static: Sequence[int] = ()) -> None:
        functools.update_wrapper(self, function)
        self.jitted = jax.jit(function, static_argnums=tuple(static))
        self._function, self._static = function, frozenset(static)
        self._programs: dict[Any, _Program | None] = {}
        self._lock = threading.RLock()

    @property
    def count(self) -> int:
        """How many programs this process has of the function."""
        kept = sum(program is not None for program in self._programs.values())
        return kept + self.jitted._cache_size()  # pyright: ignore[reportAttributeAccessIssue]

    def __call__(self, *args: Any) -> Any:
        leaves, structure = jax.tree.flatten(self._dynamic(args))
        program = self._program(args, leaves, structure)
        if program is None:
            return self.jitted(*args)
        return jax.tree.unflatten(program.result, program.call(*leaves))

    def compile(self, *args: Any) -> Callable[..., Any]:
        """The compiled program for arguments like these; it is called without the static ones."""
        leaves, structure = jax.tree.flatten(self._dynamic(args))
        program = self._program(args, leaves, structure)
        if program is None:
            return self.jitted.lower(*args).compile()
        compiled, result = program.call.lower(*leaves).compile(), program.result

        def call(*dynamic: Any) -> Any:
            flat, given = jax.tree.flatten(dynamic)
            if given != structure:
                raise TypeError(f"a program for {structure} was called with {given}")
            return jax.tree.unflatten(result, compiled(*flat))

        return call

    def _dynamic(self, args: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(arg for k, arg in enumerate(args) if k not in self._static)

    def _program(self, args: Sequence[Any], leaves: Sequence[Any], tree: Any) -> _Program | None:
        """The program for these arguments; None if it is not one that may be kept."""
        if _directory is None or not _is_plain(leaves):
            return None
        static = tuple((k, arg) for k, arg in enumerate(args) if k in self._static)
        types = tuple(jax.typeof(leaf) for leaf in leaves)
        here = _directory, static, tree, types, _settings()
        with self._lock:
            if here not in self._programs:
                self._programs[here] = self._found_or_made(_directory, args, leaves, tree)
            return self._programs[here]

    def _found_or_made(
        self, directory: Path, args: Sequence[Any], leaves: Sequence[Any], tree: Any
    ) -> _Program | None:
        packages = frozenset(n.partition(".")[0] for n in (__name__, self._function.__module__))
        try:
            key = self._key(args, leaves, packages)
        except Unknown:
            return None
        path = directory / f"{self._function.__name__.strip('_')}-{key[:40]}.program"
        known = _load(path, key)
        if known is None:
            known = self._made(args, leaves, tree)
            if known is None:
                return None
            with contextlib.suppress(Unknown):  # sources have been changed meanwhile
                if self._key(args, leaves, packages) == key:
                    _save(path, key, *known)
        exported, result = known

        def call(*flat: Any) -> Any:
            return exported.call(*flat)

        call.__name__ = self._function.__name__
        # What it returns belongs to the device, what a caller makes need not: said for all, as one
        # program would else be compiled for each mixture of both.
        here = SingleDeviceSharding(jax.devices()[0])
        compiled = jax.jit(call, in_shardings=here, out_shardings=here)
        return _Program(compiled, jax.tree.structure(result))

    def _key(self, args: Sequence[Any], leaves: Sequence[Any], packages: frozenset[str]) -> str:
        """A digest of all that a program follows from; `Unknown` if that cannot be said."""
        static = [described(a, packages) for k, a in enumerate(args) if k in self._static]
        dynamic, count = leaves_described(self._dynamic(args), packages)
        if count != len(leaves):
            raise Unknown("a tree that JAX sees in another way")
        device = jax.devices()[0]
        content = (
            MAGIC,
            [(package, _digest_of_sources(package)) for package in sorted(packages)],
            (sys.version, jax.__version__, version("jaxlib"), np.__version__),
            (device.platform, device.device_kind, device.client.platform_version),
            _settings(),
            (self._function.__module__, self._function.__qualname__, sorted(self._static)),
            static,
            dynamic,
        )
        return hashlib.sha256(repr(content).encode()).hexdigest()

    def _made(self, args: Sequence[Any], leaves: Sequence[Any], tree: Any) -> Any:
        """The exported program, and its result with numbers for leaves; None if there is none."""
        results: list[Any] = []

        def flat(*leaves: Any) -> list[Any]:
            dynamic = iter(jax.tree.unflatten(tree, leaves))
            every = [a if k in self._static else next(dynamic) for k, a in enumerate(args)]
            flattened, result = jax.tree.flatten(self._function(*every))
            results[:] = [jax.tree.unflatten(result, range(len(flattened)))]
            return flattened

        traced = jax.jit(flat)
        shapes = traced.trace(*leaves).jaxpr.out_avals  # what tracing raises, the user is to see
        if any(shape.weak_type for shape in shapes):
            return None  # an exported program does not say so
        try:
            return jax.export.export(traced)(*leaves), results[0]
        except Exception:  # whatever JAX does not export, it can still compile
            return None


def stored(function: Callable[..., Any], static: Sequence[int] = ()) -> Stored:
    """`jax.jit` of a function, whose programs are kept on disk once `keep_in` has been called.

    Args:
        function: of a module's own level, so that its name says what it is.
        static: numbers of the arguments whose values belong to the program.
    """
    return Stored(function, static)


def _is_plain(leaves: Sequence[Any]) -> bool:
    """Whether these are numbers on the host or on the first device, and JAX is not tracing."""
    config = jax.config
    if any(isinstance(leaf, Tracer) for leaf in leaves) or isinstance(jax.device_put(0.0), Tracer):
        return False
    debugging = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
    if any(getattr(config, name, True) for name in debugging) or jax.process_count() > 1:
        return False
    first = {jax.devices()[0]}
    on_devices = [leaf for leaf in leaves if isinstance(leaf, jax.Array)]
    usual = config.jax_default_device is None  # pyright: ignore[reportAttributeAccessIssue]
    return usual and all(leaf.devices() == first for leaf in on_devices)


def _settings() -> tuple[tuple[str, str], ...]:
    """All settings of JAX and of XLA that may change a program, known to this module or not."""
    values = [
        (name, repr(getattr(jax.config, name, value)))
        for name, value in jax.config.values.items()  # pyright: ignore[reportAttributeAccessIssue]
        if not name.startswith(NO_MATTER)
    ]
    flags = ("XLA_", "TF_XLA_", "LIBTPU_")
    return (*values, *((k, v) for k, v in sorted(os.environ.items()) if k.startswith(flags)))


def _digest_of_sources(package: str) -> str:
    """Of all modules of a package; `Unknown` if they may not be those that were imported."""
    module = sys.modules.get(package)
    file = Path(getattr(module, "__file__", None) or "")
    paths = sorted(file.parent.rglob("*.py")) if hasattr(module, "__path__") else [file]
    if file.suffix != ".py":
        raise Unknown(f"the sources of {package}")
    digest = hashlib.sha256()
    try:
        for path in paths:
            about, content = path.stat(), path.read_bytes()
            if max(about.st_mtime, about.st_ctime) > BEGAN:
                raise Unknown(f"{path}, which has been changed since")
            digest.update(f"{path.relative_to(file.parent)} {len(content)}\n".encode())
            digest.update(content)
    except OSError as error:
        raise Unknown(f"the sources of {package}") from error
    return digest.hexdigest()


def _load(path: Path, key: str) -> tuple[Any, Any] | None:
    """The exported program in a file, and its result; None if there is none, or a damaged one."""
    try:
        content = path.read_bytes()
        head = MAGIC + key.encode() + b"\n"
        body = content[len(head) + 65 :]
        check = hashlib.sha256(head + body).hexdigest().encode() + b"\n"
        if content[: len(head) + 65] != head + check:
            return None
        blob, result = pickle.loads(body)
        exported = jax.export.deserialize(bytearray(blob))
        # JAX does so where it traces a Cholesky factor, and never for a program that is loaded.
        jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
    except Exception:  # whatever a file of another kind makes of it
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return exported, result


def _save(path: Path, key: str, exported: Any, result: Any) -> None:
    """Writes a program in one go; what cannot be written is done without."""
    try:
        body = pickle.dumps((bytes(exported.serialize()), result))
    except Exception:  # a structure without a name, or a program that has no such form
        return
    head = MAGIC + key.encode() + b"\n"
    check = hashlib.sha256(head + body).hexdigest().encode() + b"\n"
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(head + check + body)
            os.replace(temporary, path)
        except OSError:
            os.unlink(temporary)
            raise
        _make_room(path.parent)


def _make_room(directory: Path) -> None:
    """Removes the programs that have not been used for longest, if there are too many."""
    files = [(p.stat().st_mtime, p.stat().st_size, p) for p in directory.glob("*.program")]
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MOST_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= size
