"""Find missing packages of extras. Every message about a missing package ends with the line that installs its extra."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from q2r2_control.errors import MissingPackageError

# The packages of each extra, by its name. Other extras are checked where they are used.
PACKAGES = {
    "sim": ("mujoco", "pillow"),
    "data": ("mcap", "rosbags", "zstandard", "matplotlib", "pillow"),
    "headset": ("rosbags",),
    "fri": ("protobuf",),
    "gym": ("gymnasium",),
    "web": ("viser", "msgspec", "cryptography", "segno", "trimesh", "websockets", "rosbags"),
}
# Packages whose import has another name.
_IMPORTS = {"pillow": "PIL", "protobuf": "google.protobuf"}

_CHECKOUT = Path(__file__).resolve().parents[1]


def install_line(extra: str) -> str:
    """Return the pip command that installs an ``extra`` of this package, from any working directory.

    The package is on no package index, so in a checkout the command names the checkout's folder. lerobot is large, so a
    checkout has a separate environment for it. If the environment of this Python is not activated, the line names the
    Python.
    """
    is_checkout = (_CHECKOUT / "pyproject.toml").is_file()
    if extra == "lerobot" and is_checkout:
        folder = shlex.quote(str(_CHECKOUT))
        return f"make -C {folder} lerobot, which makes {folder}/.venv-lerobot of some gigabytes"
    if is_checkout:
        return f"{_pip()} install -e '{_CHECKOUT}[{extra}]'"
    return f"{_pip()} install 'q2r2_control[{extra}]'"


def plugin_line(package: str) -> str:
    """Return the pip command that installs a ``package`` of the folder plugins/.

    If this package is not in a checkout, the command works only in the folder of a checkout.
    """
    folder = Path("plugins") / package
    return f"{_pip()} install -e {shlex.quote(str(_CHECKOUT / folder if (_CHECKOUT / folder).is_dir() else folder))}"


def require(extra: str, what: str) -> None:
    """Raise :class:`MissingPackageError` unless all packages of an ``extra`` are installed.

    ``what`` names the command, setting or file that needs them. The packages are not imported.
    """
    if missing := [package for package in PACKAGES[extra] if not _is_installed(module_of(package))]:
        raise MissingPackageError(f"{what} needs {_listed(missing)}: {install_line(extra)}")


@contextmanager
def importing(extra: str, what: str) -> Iterator[None]:
    """If an import in this context fails, do the same as :func:`require`."""
    try:
        yield
    except ModuleNotFoundError:
        require(extra, what)
        raise


def module_of(package: str) -> str:
    """Return the module by which a ``package`` of :data:`PACKAGES` is imported."""
    return _IMPORTS.get(package, package)


def _listed(names: list[str]) -> str:
    """Return ``names`` as words, such as "a, b and c"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # ``find_spec`` raises this if the package that contains the module is missing.
        return False


def _pip() -> str:
    """Return the command that runs pip for this Python. It names this Python if its environment is not activated."""
    is_active = sys.prefix == sys.base_prefix or os.environ.get("VIRTUAL_ENV") == sys.prefix
    return "pip" if is_active else f"{shlex.quote(sys.executable)} -m pip"
