"""Configuration: the YAML of a cell as checked, immutable settings. It imports nothing of the layers above.

``cell`` reads the file, and ``cameras`` checks what it says of those; ``control`` and ``teleop`` hold the settings of
those layers; ``external`` and ``presets`` describe controllers of others that can move the arms; ``timeouts`` has the
default that all streams share; ``resources`` finds the files that ship with the package.
"""

from q2r2_control.config.cell import Config, load_config
from q2r2_control.config.control import AdmittanceSettings, ControllerSettings, ImpedanceSettings
from q2r2_control.config.resources import find_resource
from q2r2_control.config.supervision import SupervisionSettings
from q2r2_control.config.teleop import TeleopSettings

__all__ = [
    "AdmittanceSettings",
    "Config",
    "ControllerSettings",
    "ImpedanceSettings",
    "SupervisionSettings",
    "TeleopSettings",
    "find_resource",
    "load_config",
]
