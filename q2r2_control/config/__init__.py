"""Turn the YAML of a cell into checked settings that never change. This package imports no package that uses it."""
