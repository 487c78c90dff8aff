"""Import the plug-in from its folder, so that its parts that need no robot are tested even if it is not installed."""

from __future__ import annotations

import sys

from tests.support.modules import ROOT

sys.path.insert(0, str(ROOT / "plugins/q2r2_franka"))
