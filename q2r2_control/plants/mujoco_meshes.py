"""Collision meshes in formats that MuJoCo has no decoder for, such as DAE: read with Coal and handed over as data."""

from __future__ import annotations

from pathlib import Path

import coal
import mujoco
import numpy as np

from q2r2_control.errors import PlantError

_FORMATS = (".stl", ".obj", ".msh")


def is_readable(file: str) -> bool:
    """Whether MuJoCo reads meshes of this file's format."""
    return Path(file).suffix.lower() in _FORMATS


def load_meshes(spec: mujoco.MjSpec) -> None:
    """Read every mesh of ``spec`` that MuJoCo cannot; their scale stays the mesh's. Raises :class:`PlantError`."""
    for mesh in spec.meshes:
        if is_readable(mesh.file):
            continue
        try:
            read = coal.MeshLoader().load(mesh.file, np.ones(3))
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[-200:]
            raise PlantError(f"{mesh.file}: neither MuJoCo nor Coal can read it: {reason}") from error
        triangles = [read.tri_indices(index) for index in range(read.num_tris)]
        mesh.uservert = np.asarray(read.vertices(), dtype=float).ravel()
        mesh.userface = np.array([[corner[0], corner[1], corner[2]] for corner in triangles], dtype=int).ravel()
        mesh.file = ""
