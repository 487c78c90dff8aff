"""Settings that change while a node runs: by ``ros2 param set``, rqt, or a service of rcl_interfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from q2r2_control.config import ImpedanceSettings
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.parameters import bounds_of, may_be_none, none_of_zero

if TYPE_CHECKING:  # arms' nodes have no controller, and need not wait for its kernels
    from q2r2_control.compliance.impedance import ImpedanceController


class LiveTeleopParameters:
    """Checks parameters ``teleop.*`` that are set together as one change, which is done as a whole or not at all."""

    def __init__(self, node: BaseNode, settings: TeleopSettings, apply: Callable[[TeleopSettings], str | None]) -> None:
        """``apply``: takes the changed settings, or returns why that is not possible now."""
        self._settings, self._apply = settings, apply
        node.add_on_set_parameters_callback(self._on_set)

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changes = {one.name: one.value for one in parameters if one.name.startswith("teleop.")}
        if not changes:
            return SetParametersResult(successful=True)
        values = self._settings.model_dump()
        for name, value in changes.items():
            _put(values, TeleopSettings, name.split(".")[1:], value)
        try:
            settings = TeleopSettings.model_validate(values)
        except ValidationError as error:
            fault = error.errors()[0]
            name = ".".join(["teleop", *map(str, fault["loc"])])
            reason = f"{name} = {fault['input']!r:.60}: {fault['msg'].removeprefix('Value error, ')}"
            return SetParametersResult(successful=False, reason=reason)
        if (problem := self._apply(settings)) is not None:
            return SetParametersResult(successful=False, reason=f"{', '.join(changes)}: {problem}")
        self._settings = settings
        return SetParametersResult(successful=True)


class LiveStiffness:
    """Parameters of the tools' stiffness in torque mode, which ramps to what is set."""

    _NAMES = ("translational_stiffness", "rotational_stiffness")

    def __init__(self, node: BaseNode, impedance: ImpedanceController) -> None:
        self._impedance = impedance
        for name in self._NAMES:
            field = ImpedanceSettings.model_fields[name]
            value, most = getattr(impedance.settings, name), bounds_of(field)["at_most"]
            words = f"{field.description}; changes over ramp_time"
            node.parameter(name, value, words, at_least=1.0, at_most=most, read_only=False)
        node.add_post_set_parameters_callback(self._on_set)

    def _on_set(self, parameters: Sequence[Parameter]) -> None:
        values = {one.name: one.value for one in parameters if one.name in self._NAMES}
        if values:
            self._impedance.set_stiffness(values.get(self._NAMES[0]), values.get(self._NAMES[1]))


def _put(values: dict[str, Any], model: type[BaseModel], path: Sequence[str], value: Any) -> None:
    """Set one field of nested values; the parameter was declared from the model, so the field is there."""
    for name in path[:-1]:
        values, model = values[name], model.model_fields[name].annotation  # type: ignore[assignment]
    values[path[-1]] = none_of_zero(value) if may_be_none(model.model_fields[path[-1]]) else value
