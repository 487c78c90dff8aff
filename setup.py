"""Settings that cannot be in pyproject.toml, and the README as package registries show it.

colcon cannot read ``python_requires`` from pyproject.toml. For ``license``, no spelling in pyproject.toml is accepted
by both the setuptools of Ubuntu 24.04 and newer ones. The links of the README have to be changed for other sites.
"""

import re
from contextlib import suppress
from pathlib import Path

from setuptools import setup

with suppress(ImportError):  # Python before 3.11 has no tomllib. pip then refuses it in one line, by python_requires.
    import tomllib

HERE = Path(__file__).resolve().parent


def readme() -> str:
    """Return README.md, in which links to files of the repository lead to ``urls.Repository``.

    Without this URL, each of these links is replaced by its text.
    """
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
