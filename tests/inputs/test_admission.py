"""Who may drive, as logic: what decides between the client that drives and one that newly connects."""

from __future__ import annotations

import math
from dataclasses import replace
from ipaddress import ip_network

import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.connections import SILENCE_ALLOWED
from q2r2_control.inputs.listener import (
    POSES_ALLOWED,
    QUIET_ALLOWED,
    WAIT_ALLOWED,
    Admission,
    Peer,
    decide,
    is_allowed,
)

NOW = 100.0
REGISTERED = ({"q2r_left_hand_pose": "geometry_msgs/PoseStamped"}, {"q2r_left_hand_haptic_feedback": "/q2r"})


DRIVER = Peer("10.0.0.7:1", "10.0.0.7", since=0.0, last_frame=NOW, last_pose=NOW, registrations=REGISTERED)
QUIET = replace(DRIVER, last_frame=NOW - 0.51, last_pose=NOW - 0.51)
IDLE = replace(DRIVER, last_pose=NOW - 5.1)
BACK = Peer("10.0.0.7:2", "10.0.0.7", NOW, NOW, registrations=REGISTERED)
STRANGER = Peer("10.0.0.8:1", "10.0.0.8", NOW, NOW, registrations=REGISTERED)
POSING = replace(STRANGER, last_pose=NOW)


@pytest.mark.parametrize(
    ("driver", "newcomer", "verdict"),
    [
        pytest.param(None, STRANGER, Admission.ADMIT, id="nobody drives"),
        pytest.param(DRIVER, BACK, Admission.REFUSE, id="same peer, but the driver is heard"),
        pytest.param(replace(DRIVER, last_frame=NOW - 0.49), BACK, Admission.REFUSE, id="same peer, a short pause"),
        pytest.param(QUIET, BACK, Admission.ADMIT, id="same peer, the driver is quiet"),
        pytest.param(QUIET, replace(BACK, registrations=(REGISTERED[0], {})), Admission.WAIT, id="half registered"),
        pytest.param(
            replace(QUIET, registrations=({}, {})),
            replace(BACK, registrations=({}, {})),
            Admission.WAIT,
            id="same host, neither has registered",
        ),
        pytest.param(QUIET, STRANGER, Admission.REFUSE, id="another host, the driver is quiet"),
        pytest.param(IDLE, POSING, Admission.ADMIT, id="poses against keepalives"),
        pytest.param(IDLE, STRANGER, Admission.WAIT, id="no poses against keepalives"),
        pytest.param(replace(IDLE, last_pose=NOW - 4.9), POSING, Admission.REFUSE, id="poses some seconds ago"),
        pytest.param(replace(IDLE, last_pose=-math.inf), POSING, Admission.ADMIT, id="a driver that never sent a pose"),
        pytest.param(IDLE, replace(STRANGER, since=NOW - 2.1), Admission.REFUSE, id="waited in vain for poses"),
        pytest.param(
            QUIET, replace(BACK, registrations=({}, {}), since=NOW - 2.1), Admission.REFUSE, id="waited in vain"
        ),
    ],
)
def test_the_place_belongs_to_who_sends_poses_and_a_peer_that_comes_back_takes_its_own(
    driver: Peer | None, newcomer: Peer, verdict: Admission
) -> None:
    decided, reason = decide(driver, newcomer, NOW)
    assert decided is verdict
    if driver is not None and verdict is not Admission.WAIT:
        assert (newcomer.peer if verdict is Admission.ADMIT else driver.peer) in reason


def test_a_driver_that_gives_way_as_quiet_moves_no_arm_any_more() -> None:
    assert 2 * STREAM_TIMEOUT < QUIET_ALLOWED < 0.5 * SILENCE_ALLOWED
    assert WAIT_ALLOWED < POSES_ALLOWED


@pytest.mark.parametrize(
    ("host", "admitted"),
    [
        ("192.168.1.7", True),
        ("10.1.2.3", True),
        ("10.1.2.4", False),
        ("fd00::7", True),
        ("fe80::1%eth0", True),
    ],
)
def test_a_host_is_allowed_where_one_of_the_networks_has_it(host: str, admitted: bool) -> None:
    networks = [ip_network(text) for text in ("192.168.1.0/24", "10.1.2.3", "fd00::/64", "fe80::/10")]
    assert is_allowed(host, networks) is admitted
    assert is_allowed(host, None)
