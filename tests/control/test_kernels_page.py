"""The template of docs/kernels.md compiles and runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

PAGE = Path(__file__).parents[2] / "docs" / "kernels.md"


def test_the_template_compiles_and_sees_what_changes_in_the_model(tmp_path: Path) -> None:
    (template,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    source = tmp_path / "spring.py"
    source.write_text(template)
    found: dict[str, Any] = {"__name__": "spring"}
    exec(compile(template, str(source), "exec"), found)
    found["model"].stiffness[0] = 10.0
    assert found["torque"](found["pointer"], found["q"], found["tau"])
    np.testing.assert_allclose(found["tau"], -1.0)
    found["q"][3] = np.nan
    assert not found["torque"](found["pointer"], found["q"], found["tau"])
