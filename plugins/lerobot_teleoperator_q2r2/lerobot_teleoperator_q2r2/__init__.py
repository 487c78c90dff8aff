"""Hands of q2r2_control as lerobot's teleoperator ``q2r2_hands``."""

from lerobot_teleoperator_q2r2.hands import Q2R2Hands, Q2R2HandsConfig

__all__ = ["Q2R2Hands", "Q2R2HandsConfig"]
