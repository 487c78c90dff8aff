"""Settings that users change while a node runs.

If a user changes several settings at once and one of them cannot change, none changes, and the answer says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from q2r2_control.config.control import LIVE, LIVE_IMPEDANCE, ControllerSettings, ImpedanceSettings
from q2r2_control.config.strict import Model, validated
from q2r2_control.config.teleop import GuardSettings, TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.pairs import CLEARANCE
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.parameters import may_be_none, range_of, stance_of

# These modules are not imported at run time, because the nodes of arms have no controller, and must not spend time on
# loading its kernels.
if TYPE_CHECKING:
    from q2r2_control.compliance.impedance import ImpedanceController
    from q2r2_control.control.controller import CartesianController
    from q2r2_control.supervision.joint_watch import ExternalSettings, WatchSettings
    from q2r2_control.supervision.target_stream import StreamSettings

# For each setting of the controller's checks: field, parameter, description, least and greatest value.
_Table = tuple[tuple[str, str, str, float, float], ...]
_STREAMS: _Table = (
    ("timeout", "target_timeout", "an arm without targets for this long holds [s]", 0.02, 2.0),
    ("engage_distance", "engage_distance", "targets have to begin this near to the tool [m]", 0.0, 0.2),
    ("engage_angle", "engage_angle", "and turned from it by no more [rad]", 0.0, 1.5),
)
_WATCH: _Table = (
    ("timeout", "joint_state_timeout", "without joint states, or a tick, for this long the arms brake [s]", 0.01, 1.0),
    ("settle_time", "settle_time", "joint states have to be good and at rest before activation [s]", 0.02, 10.0),
    ("deviation", "max_deviation", "of a joint from its reference [rad]", 0.01, 3.0),
    ("deviation_time", "deviation_time", "for this long stops the arms [s]", 0.05, 10.0),
)
_EXTERNAL: _Table = (
    ("tolerance", "distance_tolerance", "output none: measured pairs may be closer than min_distance [m]", 0.0, 0.1),
)
_MIRROR = ("mirror", "mirror_reflected")


class LiveArmParameters:
    """The parameters ``teleop.*``, ``guard.*`` and ``mirror`` of an arm's node."""

    def __init__(
        self,
        node: BaseNode,
        teleop: TeleopSettings,
        guard: GuardSettings,
        apply: Callable[[TeleopSettings, GuardSettings], str | None],
    ) -> None:
        """Watch the parameters; ``apply`` uses changed settings, or returns why they cannot change now."""
        self._node, self._teleop, self._guard, self._apply = node, teleop, guard, apply
        node.add_on_set_parameters_callback(self._on_set)

    def _on_set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        changes = {one.name: one.value for one in parameters}
        if not any(is_of_teleop(name) or name.startswith("guard.") for name in changes):
            return SetParametersResult(successful=True)
        try:
            mirror = [bool(changes.get(name, self._node.get_parameter(name).value)) for name in _MIRROR]
            teleop = _changed(self._teleop, "teleop", changes).model_copy(update={"stance": stance_of(*mirror)})
            guard = _changed(self._guard, "guard", changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if (problem := self._apply(teleop, guard)) is not None:
            return SetParametersResult(successful=False, reason=f"{', '.join(changes)}: {problem}")
        self._teleop, self._guard = teleop, guard
        return SetParametersResult(successful=True)


def make_control_live(node: BaseNode, controller: CartesianController) -> None:
    """Declare the parameters ``control.*`` for settings that may change. The controller accepts or refuses a change."""
    for name in LIVE:
        field = ControllerSettings.model_fields[name]
        value, within = getattr(controller.settings, name), range_of(field)
        if name == "min_distance":
            # The range is given here, because the metadata of this field do not contain the bounds of its type.
            within = 0.0, max(CLEARANCE, value)
        node.parameter(f"control.{name}", value, field.description or name, read_only=False, within=within)

    def on_set(parameters: Sequence[Parameter]) -> SetParametersResult:
        values = _within("control", {one.name: one.value for one in parameters})
        problem = controller.change(values) if values else None
        return SetParametersResult(successful=problem is None, reason=problem or "")

    node.add_on_set_parameters_callback(on_set)


def make_impedance_live(node: BaseNode, impedance: ImpedanceController) -> None:
    """Declare the parameters of the impedance in torque mode. The impedance changes gradually to new values."""
    for name in LIVE_IMPEDANCE:
        field = ImpedanceSettings.model_fields[name]
        value, bounds = getattr(impedance.settings, name), range_of(field)
        assert bounds is not None
        # The range begins above 0, because its ends are allowed values, and no such parameter may be 0.
        within = max(bounds[0], min(0.1, value)), bounds[1]
        node.parameter(name, value, f"{field.description}; changes over ramp_time", read_only=False, within=within)

    def on_set(parameters: Sequence[Parameter]) -> None:
        if values := {one.name: one.value for one in parameters if one.name in LIVE_IMPEDANCE}:
            impedance.change(values)

    node.add_post_set_parameters_callback(on_set)


def make_watching_live(
    node: BaseNode, streams: StreamSettings, watch: WatchSettings, external: ExternalSettings
) -> None:
    """Declare the timeouts and tolerances of the controller's node, which are read at every tick."""
    settings: dict[str, tuple[Any, str]] = {}
    for target, table in ((streams, _STREAMS), (watch, _WATCH), (external, _EXTERNAL)):
        for field, name, what, least, greatest in table:
            default = getattr(target, field)
            value = node.parameter(name, default, what, within=(least, greatest), read_only=False)
            setattr(target, field, value)
            settings[name] = target, field

    def on_set(parameters: Sequence[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in settings:
                target, field = settings[parameter.name]
                setattr(target, field, parameter.value)

    node.add_post_set_parameters_callback(on_set)


def is_of_teleop(name: str) -> bool:
    """Return whether a parameter belongs to the teleoperation that all arms share."""
    return name in _MIRROR or name.startswith("teleop.")


def _within(prefix: str, changes: Mapping[str, Any]) -> dict[str, Any]:
    begin = f"{prefix}."
    return {name.removeprefix(begin): value for name, value in changes.items() if name.startswith(begin)}


def _changed(settings: Model, prefix: str, changes: Mapping[str, Any]) -> Model:
    """Return the settings with the changes of parameters under ``prefix``; raises :class:`ConfigError`."""
    values = settings.model_dump()
    for name, value in _within(prefix, changes).items():
        *path, last = name.split(".")  # The field exists, because the model declared the parameter.
        part, model = values, type(settings)
        for each in path:
            part, model = part[each], model.model_fields[each].annotation  # type: ignore[assignment]
        part[last] = value or None if may_be_none(model.model_fields[last]) else value
    return validated(type(settings), f"parameter {prefix}.", values)
