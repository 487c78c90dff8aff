"""Turn the YAML of a cell into checked, immutable settings. This package imports no package that uses it."""
