"""Settings that colcon needs beside pyproject.toml to build an ament_python package, and the README as others show it.

Two keys stand here. The first does since colcon cannot read it from pyproject.toml, the second since no spelling of it
there suits both the setuptools of Ubuntu 24.04 and new ones.
"""

import re
from contextlib import suppress
from pathlib import Path

from setuptools import setup

with suppress(ImportError):  # before Python 3.11, which pip then refuses in one line, by python_requires
    import tomllib

HERE = Path(__file__).resolve().parent


def readme() -> str:
    """README.md, whose links into the repository lead to ``urls.Repository``, or are text where there is none."""
    repository = None
    with suppress(NameError):
        project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        repository = project.get("urls", {}).get("Repository")

    def elsewhere(link: re.Match[str]) -> str:
        mark, text, path = link.groups()
        return f"{mark}[{text}]({repository}/{'raw' if mark else 'blob'}/main/{path})" if repository else text

    text = (HERE / "README.md").read_text(encoding="utf-8")
    return re.sub(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]*)\)", elsewhere, text)


setup(
    python_requires=">=3.11,<3.15",
    license="Apache-2.0",
    long_description=readme(),
    long_description_content_type="text/markdown",
)
