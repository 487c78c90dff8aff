"""Configuration: a cell's YAML as checked, immutable settings. This package imports nothing from the layers above."""
