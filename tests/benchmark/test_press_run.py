"""A finger pressed on the table through controller, impedance and MuJoCo."""

from __future__ import annotations

import pytest

from q2r2_control import load_config
from q2r2_control.benchmark.press_run import COMMANDED, PressSlide, run_press
from q2r2_control.errors import ConfigError
from q2r2_control.verification.contact_cells import TABLE_ONLY, with_contact

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")
STIFFNESS = CONFIG.impedance.translational_stiffness


@pytest.mark.parametrize(
    ("slide", "rotor_share", "friction"), [(PressSlide.AWAY, 1.0, 0.6), (PressSlide.TOWARDS, 0.1, 0.9)], ids=str
)
def test_what_is_commanded_into_the_table_presses_as_the_stiffness_says_and_slides_without_losing_contact(
    slide: PressSlide, rotor_share: float, friction: float
) -> None:
    press = run_press(with_contact(CONFIG, TABLE_ONLY), slide, rotor_share, friction)
    assert press.violations == 0
    assert press.impact_speed < 0.04
    assert press.bounce_s == 0.0
    assert press.steady_force == pytest.approx(press.spring_force, rel=0.02)
    # The table gives way by some tenths of a millimetre.
    assert press.steady_force == pytest.approx(STIFFNESS * COMMANDED, rel=0.1)
    assert press.largest_force < press.bound
    # At every tick of the slide and of the rest after it.
    assert press.lost_contact_s == 0.0
    assert press.slide_least > 0.8 * press.steady_force
    assert press.slide_largest < 1.35 * press.steady_force
    assert press.slide_force == pytest.approx(press.steady_force, rel=0.07)
    # The spring pulls the finger along when it is as strong as friction.
    assert press.slide_error_mm == pytest.approx(press.friction_lag_mm, abs=2.5)


def test_a_cell_where_the_fingers_may_not_touch_the_table_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"control\.contact_allowed: nothing of arm left's fingers and table"):
        run_press(CONFIG, PressSlide.AWAY, rotor_share=1.0, friction=0.6)
