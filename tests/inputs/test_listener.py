"""The headset server's listener bounds rates, logs few lines, decides who drives, and makes texts about addresses."""

from __future__ import annotations

import logging
import math
import socket
from dataclasses import replace
from ipaddress import ip_address, ip_network

import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.addresses import NO_NETWORK
from q2r2_control.inputs.connections import SILENCE_ALLOWED
from q2r2_control.inputs.listener import (
    MAX_HOSTS_NAMED,
    POSES_ALLOWED,
    QUIET_ALLOWED,
    WAIT_ALLOWED,
    Admission,
    HostLog,
    Peer,
    RateLimit,
    access_lines,
    app_settings,
    decide,
    is_allowed,
    written,
)

INFO, WARNING = logging.INFO, logging.WARNING


def test_a_rate_limit_allows_the_same_count_in_each_period_even_if_the_period_before_was_not_used() -> None:
    limit = RateLimit(3, 0.5)
    assert [limit.take(10.0) for _ in range(5)] == [True, True, True, False, False]
    assert not limit.is_open(10.25)
    assert not limit.take(10.25)
    assert limit.is_open(10.5)
    assert [limit.take(20.0) for _ in range(5)] == [True, True, True, False, False]


class Lines(logging.Logger):
    """A logger that keeps its lines, and :attr:`log_of_hosts`, which writes to this logger."""

    def __init__(self) -> None:
        super().__init__("lines")
        self.lines: list[str] = []
        self.log_of_hosts = HostLog(self)

    def handle(self, record: logging.LogRecord) -> None:
        self.lines.append(f"{record.levelname} {record.getMessage()}")


def test_the_first_line_about_a_host_is_written_at_once_and_later_one_line_a_second_counts_omitted_lines() -> None:
    lines = Lines()
    log = lines.log_of_hosts
    for index in range(3000):
        log.write("a", WARNING, f"line {index}", 10.0 + index / 1000.0)
    log.flush(12.9)
    first = ["WARNING line 0", "WARNING line 999 (998 more left out)", "WARNING line 1999 (999 more left out)"]
    assert lines.lines == first
    log.flush(13.1)
    log.flush(99.0)
    assert lines.lines == [*first, "WARNING line 2999 (999 more left out)"]


def test_lines_within_the_same_second_are_written_later_as_one_line_and_the_most_important_is_kept() -> None:
    lines = Lines()
    log = lines.log_of_hosts
    log.write("a", INFO, "connected", 10.0)
    log.write("a", WARNING, "dropped", 10.2)
    log.flush(10.9)
    assert lines.lines == ["INFO connected"]
    log.flush(11.0)
    assert lines.lines == ["INFO connected", "WARNING dropped"]
    log.write("a", WARNING, "refused", 11.5)
    log.write("a", INFO, "connected", 11.6)
    log.flush(math.inf)
    assert lines.lines[2:] == ["WARNING refused (1 more left out)"]


def test_the_log_has_separate_lines_for_eight_hosts_and_one_common_line_for_all_further_hosts() -> None:
    lines = Lines()
    for index in range(100):
        lines.log_of_hosts.write(f"host {index}", WARNING, f"line {index}", 10.0)
    assert lines.lines == [f"WARNING line {index}" for index in range(MAX_HOSTS_NAMED + 1)]
    lines.log_of_hosts.flush(math.inf)
    assert lines.lines[MAX_HOSTS_NAMED + 1 :] == ["WARNING line 99 (90 more left out)"]


@pytest.mark.parametrize("host", ["0.0.0.0", "::", ""])
def test_a_server_on_all_networks_names_addresses_of_this_machine_for_the_app(host: str) -> None:
    assert written("127.0.0.1", 10007) == "127.0.0.1:10007"
    assert written("::", 10007) == "[::]:10007"
    settings = app_settings(host, 10007)
    assert settings.endswith(", port 10007, protocol ROS2")
    addresses = settings.removeprefix("address ").split(",")[0].split(" or ")
    for address in addresses if addresses != [NO_NETWORK] else ():
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as own:
            own.bind((address, 0))
        assert not ip_address(address).is_unspecified


def test_a_server_says_which_hosts_can_drive_and_how_to_change_that() -> None:
    enter, drivers = access_lines("192.168.1.20", 10000, None)
    assert enter == "enter in the app: address 192.168.1.20, port 10000, protocol ROS2"
    assert drivers.startswith("whoever reaches this port can drive the arms")
    assert "headset.allow" in drivers
    _, drivers = access_lines("0.0.0.0", 10000, (ip_network("192.168.1.0/24"), ip_network("10.0.0.7")))
    assert drivers.startswith("only 192.168.1.0/24, 10.0.0.7/32 can drive")
    (line,) = access_lines("127.0.0.1", 10000, None)
    assert "this machine only" in line
    assert "--host 0.0.0.0" in line


NOW = 100.0
REGISTERED = ({"q2r_left_hand_pose": "geometry_msgs/PoseStamped"}, {"q2r_left_hand_haptic_feedback": "/q2r"})
DRIVER = Peer("10.0.0.7:1", "10.0.0.7", since=0.0, last_frame=NOW, last_pose=NOW, registrations=REGISTERED)
QUIET = replace(DRIVER, last_frame=NOW - 0.51, last_pose=NOW - 0.51)
IDLE = replace(DRIVER, last_pose=NOW - 5.1)
BACK = Peer("10.0.0.7:2", "10.0.0.7", NOW, NOW, registrations=REGISTERED)
STRANGER = Peer("10.0.0.8:1", "10.0.0.8", NOW, NOW, registrations=REGISTERED)
POSING = replace(STRANGER, last_pose=NOW)
SILENT = replace(BACK, registrations=({}, {}))


@pytest.mark.parametrize(
    ("driver", "newcomer", "verdict"),
    [
        pytest.param(None, STRANGER, Admission.ADMIT, id="nobody drives"),
        pytest.param(DRIVER, BACK, Admission.REFUSE, id="same peer, but the driver is heard"),
        pytest.param(replace(DRIVER, last_frame=NOW - 0.49), BACK, Admission.REFUSE, id="same peer, a short pause"),
        pytest.param(QUIET, BACK, Admission.ADMIT, id="same peer, the driver is quiet"),
        pytest.param(QUIET, replace(BACK, registrations=(REGISTERED[0], {})), Admission.WAIT, id="half registered"),
        pytest.param(replace(QUIET, registrations=({}, {})), SILENT, Admission.WAIT, id="neither has registered"),
        pytest.param(QUIET, STRANGER, Admission.REFUSE, id="another host, the driver is quiet"),
        pytest.param(IDLE, POSING, Admission.ADMIT, id="poses against keepalives"),
        pytest.param(IDLE, STRANGER, Admission.WAIT, id="no poses against keepalives"),
        pytest.param(replace(IDLE, last_pose=NOW - 4.9), POSING, Admission.REFUSE, id="poses some seconds ago"),
        pytest.param(replace(IDLE, last_pose=-math.inf), POSING, Admission.ADMIT, id="a driver that never sent a pose"),
        pytest.param(IDLE, replace(STRANGER, since=NOW - 2.1), Admission.REFUSE, id="waited in vain for poses"),
        pytest.param(QUIET, replace(SILENT, since=NOW - 2.1), Admission.REFUSE, id="waited in vain"),
    ],
)
def test_a_client_with_poses_replaces_a_driver_without_poses_and_a_returning_headset_replaces_its_old_connection(
    driver: Peer | None, newcomer: Peer, verdict: Admission
) -> None:
    decided, reason = decide(driver, newcomer, NOW)
    assert decided is verdict
    if driver is not None and verdict is not Admission.WAIT:
        assert (newcomer.peer if verdict is Admission.ADMIT else driver.peer) in reason


def test_another_client_replaces_a_silent_driver_only_after_the_timeout_that_stops_the_arms() -> None:
    assert 2 * STREAM_TIMEOUT < QUIET_ALLOWED < 0.5 * SILENCE_ALLOWED
    assert WAIT_ALLOWED < POSES_ALLOWED


def test_a_host_is_allowed_if_one_of_the_networks_contains_it() -> None:
    networks = [ip_network(text) for text in ("192.168.1.0/24", "10.1.2.3", "fd00::/64", "fe80::/10")]
    for host in ("192.168.1.7", "10.1.2.3", "fd00::7", "fe80::1%eth0"):
        assert is_allowed(host, networks)
    assert not is_allowed("10.1.2.4", networks)
    assert is_allowed("10.1.2.4", None)
