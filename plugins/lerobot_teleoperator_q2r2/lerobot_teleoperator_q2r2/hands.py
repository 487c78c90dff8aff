"""A teleoperator of lerobot: the hands of a headset, of a page or of a script. They move a cell in the same program.

The samples of the hands go to the cell's own loop, with its clutch, leash and vibrations. As the action, lerobot gets
the controller's reference.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from lerobot_robot_q2r2 import Q2R2Cell

from q2r2_control.inputs import WebInput, adapted, make_input
from q2r2_control.viewer import PageView

_logger = logging.getLogger(__name__)


@TeleoperatorConfig.register_subclass("q2r2_hands")
@dataclass(kw_only=True)
class Q2R2HandsConfig(TeleoperatorConfig):
    """The settings of the hands."""

    input: str = "headset"  # Name of an installed input: headset, web, scripted, or one of another package.
    options: dict[str, Any] = field(default_factory=dict)  # Options of the input, such as {trajectory: circle}.
    web_host: str = "127.0.0.1"  # Address on which the page of the input web is served.
    web_port: int = 8080  # Port on which the page of the input web is served.


class Q2R2Hands(Teleoperator):
    """Hands that engage the arms by a press, as in ``q2r2 run``. They move the cell that was created last.

    The hands have a clutch, so ``lerobot-rollout`` needs ``--strategy.smooth_handover=false``.
    """

    config_class = Q2R2HandsConfig
    name = "q2r2_hands"

    def __init__(self, config: Q2R2HandsConfig) -> None:
        super().__init__(config)
        self.config = config
        self._attached: ExitStack | None = None

    @property
    def _cell(self) -> Q2R2Cell:
        if Q2R2Cell.newest is None:
            raise DeviceNotConnectedError(f"{self}: there is no cell; allowed: a robot of --robot.type=q2r2_cell")
        return Q2R2Cell.newest

    @property
    def action_features(self) -> dict[str, Any]:
        return self._cell.action_features

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._attached is not None

    def connect(self, calibrate: bool = True) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError
        door, pipeline = self._cell.hands, self._cell.pipeline
        hands = make_input(self.config.input, pipeline.config, say=_logger.info, **self.config.options)
        with ExitStack() as attached:
            door.operator = hands
            attached.callback(setattr, door, "operator", None)
            if (cell := adapted(self.config.input, pipeline.config)) is not pipeline.config:
                pipeline.change_teleop(cell.teleop)
            if isinstance(hands, WebInput):
                page = attached.enter_context(PageView(self.config.web_host, self.config.web_port))
                page.begin(pipeline, self.name, recorded=False)
                for line in page.lines:
                    _logger.info("%s", line)
                attached.callback(pipeline.listeners.remove, page)
            attached.callback(hands.close)
            hands.start()
            self._attached = attached.pop_all()

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self}: not connected")
        return self._cell.hands_action()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing, because the cell's own loop sends vibrations to the hands."""

    def disconnect(self) -> None:
        if self._attached is None:
            raise DeviceNotConnectedError(f"{self}: not connected")
        self._attached.close()
        self._attached = None
