"""Settings that colcon needs beside pyproject.toml to build an ament_python package.

Two keys stand here. The first does since colcon cannot read it from pyproject.toml, the second since no spelling of it
there suits both the setuptools of Ubuntu 24.04 and new ones.
"""

from setuptools import setup

setup(python_requires=">=3.11", license="Apache-2.0")
