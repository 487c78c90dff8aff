"""Make the line that installs the packages of an extra. Every message about a missing package ends with this line."""

from __future__ import annotations

from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[1]


def install_line(extra: str) -> str:
    """Return the pip command that installs an ``extra`` of this package, from any working directory.

    The package is on no package index, so a checkout is named by its folder.
    """
    if (_CHECKOUT / "pyproject.toml").is_file():
        return f"pip install -e '{_CHECKOUT}[{extra}]'"
    return f"pip install 'q2r2_control[{extra}]'"
