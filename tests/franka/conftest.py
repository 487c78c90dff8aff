"""The plug-in is imported from its folder, so that what needs no robot is tested where it is not installed."""

from __future__ import annotations

import sys

from tests.support.modules import ROOT

sys.path.insert(0, str(ROOT / "plugins/q2r2_franka"))
