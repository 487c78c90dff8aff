"""How the packages of an extra are installed: the one line that every message about a missing package ends with."""

from __future__ import annotations

from pathlib import Path

_CHECKOUT = Path(__file__).resolve().parents[1]


def install_line(extra: str) -> str:
    """The call of pip that installs an ``extra`` of this package, wherever it is typed.

    The package is on no index of packages, so a checkout is named by its folder.
    """
    if (_CHECKOUT / "pyproject.toml").is_file():
        return f"pip install -e '{_CHECKOUT}[{extra}]'"
    return f"pip install 'q2r2_control[{extra}]'"
