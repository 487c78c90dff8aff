"""Find the shipped config/ and robots/ files: beside the package in a checkout, or under share/ if installed."""

from __future__ import annotations

import os
import sysconfig
from collections.abc import Iterator
from difflib import get_close_matches
from itertools import chain
from pathlib import Path

from q2r2_control.errors import ConfigError, shown

_CHECKOUT = Path(__file__).resolve().parents[2]


def resource_roots() -> Iterator[Path]:
    """Yield the folders that can hold config/ and robots/, in the order in which they are searched."""
    yield _CHECKOUT
    installed = [Path(sysconfig.get_path("data", scheme)) for scheme in ("venv", "posix_user", "posix_prefix")]
    # With pip --target, share/ is beside the package. With colcon, the package is in lib/python3.x/site-packages, and
    # share/ is beside lib/.
    installed += [_CHECKOUT, *_CHECKOUT.parents[2:3]]
    yield from (root / "share" / "q2r2_control" for root in installed)


def find_resource(path: str | os.PathLike[str]) -> Path:
    """Find ``path`` from the working directory, then among the shipped files.

    Raises:
        ConfigError: If there is no such file, or if the path cannot be looked up.
    """
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"{shown(path)}: allowed: the path of a file, as text or pathlib.Path")
    wanted = Path(path)
    try:
        wanted = wanted.expanduser()
        roots = () if wanted.is_absolute() else resource_roots()
        for candidate in chain([wanted], (root / wanted for root in roots)):
            if candidate.is_file():
                return candidate
        if str(path) and wanted.is_dir():
            raise ConfigError(f"{path}: a folder; allowed: the path of a file")
    except (OSError, ValueError, RuntimeError) as error:
        # The name is too long, entering a folder is not permitted, or the user of a home folder is not known.
        raise ConfigError(f"{path!s:.120}: cannot be looked up: {error!s:.120}") from error
    raise ConfigError(f"{path}: no such file here, nor among the shipped ones{_shipped(wanted)}")


def _shipped(wanted: Path) -> str:
    """Return the end of an error message: the name that was probably meant, or the shipped files of the same kind."""
    names = {
        f"{folder}/{file.name}"
        for root in resource_roots()
        for folder in ("config", "robots")
        for file in (root / folder).glob("*.*")
        if file.is_file()
    }
    if meant := get_close_matches(str(wanted), names, n=1, cutoff=0.85):
        return f"; did you mean {meant[0]}?"
    of_kind = sorted(name for name in names if name.endswith(wanted.suffix or ".yaml"))
    return f" ({', '.join(of_kind)})" if of_kind else ""
