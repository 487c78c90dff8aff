"""Configuration: the YAML of a cell as checked, immutable settings. It imports nothing of the layers above."""
