"""What makes a control loop stop its arms, with units and ranges: the same for the pipeline and the ROS nodes."""

from __future__ import annotations

from pydantic import Field

from q2r2_control.config.strict import StrictModel


class SupervisionSettings(StrictModel):
    """Limits of what a plant may measure, and of what a stream of targets may be."""

    state_timeout: float = Field(0.1, ge=0.01, le=1, description="without a measured state for this long: stop [s]")
    unusable_time: float = Field(0.05, ge=0, le=0.5, description="states that are not finite are bridged for this [s]")
    settle_time: float = Field(0.1, ge=0.02, le=10, description="states good and at rest before arms may move [s]")
    max_deviation: float = Field(0.15, ge=0.01, le=3, description="of a measured joint from its reference [rad]")
    max_deviation_torque: float = Field(
        1.5, ge=0.01, le=3, description="the same in torque mode, where arms that are pushed yield [rad]"
    )
    deviation_time: float = Field(0.5, ge=0.05, le=10, description="a longer deviation stops the arms [s]")
