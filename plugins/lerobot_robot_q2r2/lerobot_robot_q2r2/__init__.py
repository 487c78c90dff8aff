"""A cell of q2r2_control as lerobot's robot ``q2r2_cell``."""

from lerobot_robot_q2r2.cell import Q2R2Cell, Q2R2CellConfig

__all__ = ["Q2R2Cell", "Q2R2CellConfig"]
