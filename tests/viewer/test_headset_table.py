"""A headset's topics as text: topics with messages, topics without any, and topics whose messages have stopped."""

from __future__ import annotations

import numpy as np

from q2r2_control.inputs.messages import HandPose, HandTwist
from q2r2_control.inputs.session import TopicStatistics
from q2r2_control.types import HandInputs
from q2r2_control.viewer.headset_table import short_text, topic_line, topic_table
from tests.cli.test_output import printed

POSE = HandPose(np.array([0.1, -0.001, 2.0]), np.array([0.0, 0.0, 0.0, -1.0]), 0.0, "")
TOPIC = TopicStatistics(count=12, rate=75.0, age=0.25, last=POSE)


def test_the_line_of_a_topic_has_count_rate_age_and_rounded_values_or_says_that_nothing_came() -> None:
    pose = "0.10 0.00 2.00 m, quaternion 0.00 0.00 0.00 -1.00"
    assert topic_line("pose", TOPIC, False) == f"pose: 12 messages, 75 Hz, 0.25 s old: {pose}"
    assert topic_line("pose", TOPIC, True).startswith("pose: timeout, 12 messages")
    assert topic_line("pose", None, True) == "pose: timeout, nothing yet"
    assert short_text(HandTwist(np.array([1.0, 2.0, 3.0]), np.zeros(3))) == "1.00 2.00 3.00 m/s, 0.00 0.00 0.00 rad/s"
    inputs = HandInputs(button_upper=True, button_lower=True, press_middle=1.0, thumb_stick_vertical=-0.5)
    assert short_text(inputs) == "held: upper lower, triggers 0.0 1.0, stick 0.0 -0.5"
    assert short_text(HandInputs()).startswith("held: none")


def test_the_table_has_a_row_for_each_topic_and_marks_topics_that_have_stopped() -> None:
    text = printed(topic_table("hands", {"pose": TOPIC, "inputs": None, "twist": TOPIC}, ["inputs", "twist"]), 160)
    for name, expected in (("pose", "0.25"), ("inputs", "timeout  nothing yet"), ("twist", "timeout  0.10 0.00 2.00")):
        (row,) = (line for line in text.splitlines() if name in line)
        assert expected in row
        assert ("timeout" in row) == (name != "pose")
