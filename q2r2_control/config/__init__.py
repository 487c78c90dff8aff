"""Configuration: the YAML of a cell as checked, immutable settings. It imports nothing of the layers above.

``cell`` reads the file, and ``cameras`` checks what it says of those; ``control`` and ``teleop`` hold the settings of
those layers; ``external`` and ``presets`` describe controllers of others that can move the arms; ``timeouts`` has the
default that all streams share; ``resources`` finds the files that ship with the package.
"""
