"""A finger pressed on the table through controller, impedance and MuJoCo."""

from __future__ import annotations

import pytest

from q2r2_control import load_config
from q2r2_control.benchmark.press_run import COMMANDED, run_press
from q2r2_control.errors import ConfigError
from q2r2_control.verification.contact_cells import TABLE_ONLY, with_contact

CONFIG = load_config("config/dual_iiwa7.yaml")
STIFFNESS = CONFIG.impedance.translational_stiffness


def test_ten_millimetres_commanded_into_the_table_press_as_the_stiffness_says_and_slide() -> None:
    press = run_press(with_contact(CONFIG, TABLE_ONLY), rotor_share=0.1)
    assert press.violations == 0
    assert press.impact_speed < 0.04
    assert press.bounce_s == 0.0
    assert press.steady_force == pytest.approx(press.spring_force, rel=0.02)
    # The table gives way by some tenths of a millimetre.
    assert press.steady_force == pytest.approx(STIFFNESS * COMMANDED, rel=0.1)
    assert press.largest_force < 1.2 * press.bound
    # The spring pulls the finger along when it is as strong as friction.
    assert press.slide_error_mm < 7.0
    assert press.slide_force == pytest.approx(press.steady_force, rel=0.1)


def test_a_cell_where_the_fingers_may_not_touch_the_table_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"control\.contact_allowed: nothing of arm left's fingers and table"):
        run_press(CONFIG, rotor_share=1.0)
