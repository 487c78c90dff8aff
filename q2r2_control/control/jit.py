"""Compile the hot path with Numba and keep the machine code between runs.

Numba's own cache looks only at the file of the compiled function, so a kernel that calls another module's kernel
would go on running that module's old code after an edit. A controller must not run yesterday's mathematics: the
cache folder is named by a hash of every source file of this package that machine code is made from, so any edit of
one compiles afresh.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import types
from numba.experimental import structref

_ROOMS = ("control", "compliance")
_COMPILED = re.compile(r"^@(lean_|inlined_)?kernel|\bNamedTuple\b|\bstructref\b", re.MULTILINE)


def compiled_sources() -> list[Path]:
    """Files that hold kernels or the types of their arguments; they take constants from no other file."""
    package = Path(__file__).parents[1]
    sources = sorted(source for room in _ROOMS for source in (package / room).rglob("*.py"))
    return [source for source in sources if _COMPILED.search(source.read_text(encoding="utf-8"))]


def _cache_folder() -> Path:
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in compiled_sources())).hexdigest()[:16]
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "q2r2_control"
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=root):
            pass
    except (OSError, RuntimeError):
        # Numba loads what it finds there as code, so a folder that others could have made will not do.
        root = Path(tempfile.mkdtemp(prefix="q2r2_control-"))
    return root / digest


_FOLDER = str(_cache_folder())


# Set by Numba at run time, so no type checker knows its members.
config: Any = numba.config


@structref.register
class _HeldType(types.StructRef):
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Held(structref.StructRefProxy):
    """A named tuple of arrays behind one pointer: made by :func:`hold`, read in a kernel as ``held.value``.

    Handing a kernel fifty arrays costs more than the work it does; a pointer costs the same for any number.
    """

    value: Any

    def __new__(cls, value: Any) -> Held:
        held: Held = structref.StructRefProxy.__new__(cls, value)
        return held


structref.define_proxy(Held, _HeldType, ["value"])


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call; strict IEEE arithmetic, no Python objects, division by 0 gives inf."""
    return _compiled(function)


def lean_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """A :func:`kernel` that allocates nothing, so that arrays pass through its calls without being counted.

    Counting references to the twenty arrays of a call takes longer than measuring a pair of capsules.
    """
    return _compiled(function, _nrt=False)


def inlined_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """A :func:`lean_kernel` that becomes part of its callers: for a small one that is handed a whole model and data.

    Passing a hundred arrays that it does not read takes longer than its work.
    """
    return _compiled(function, _nrt=False, forceinline=True)


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    previous = config.CACHE_DIR
    config.CACHE_DIR = _FOLDER  # read once, while decorating
    try:
        compiled: Callable[..., Any] = numba.njit(function, cache=True, error_model="numpy", nogil=True, **options)
    finally:
        config.CACHE_DIR = previous
    return compiled


@kernel
def hold(value: Any) -> Held:
    """Put ``value`` behind a pointer."""
    return Held(value)


def bound(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """A kernel's machine code for arguments of the types of these, with which it runs once.

    A kernel looks at the type of each argument at each call, which for a :class:`Held` takes longer than a small
    kernel's work. What is returned does not look: hand it arguments of exactly these types, and arrays of their layout.
    """
    function(*arguments)
    # Set by Numba at run time too.
    dispatcher: Any = function
    code: Callable[..., Any] = dispatcher.get_overload(tuple(numba.typeof(argument) for argument in arguments))
    return code
