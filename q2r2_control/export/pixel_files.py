"""Pictures as they are, in HDF5 files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import ConfigError
from q2r2_control.export.pictures import Pixels

PICTURES = "pictures"  # the only dataset of such a file
_COMPRESSION = 1  # of gzip's levels, the fastest


def require_h5py() -> Any:
    """The module h5py. Raises :class:`ConfigError` where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise ConfigError("export hdf5 needs h5py: pip install 'q2r2_control[export]'") from error
    return h5py


def write_pixels(pictures: Iterable[Pixels], count: int, camera: CameraConfig, path: Path) -> None:
    """Write ``count`` pictures of a camera, each by itself, so that one can be read without the others."""
    size = (camera.height, camera.width, 3)
    with require_h5py().File(path, "w") as file:
        data = file.create_dataset(
            PICTURES, (count, *size), "uint8", chunks=(1, *size), compression="gzip", compression_opts=_COMPRESSION
        )
        for number, pixels in enumerate(pictures):
            data[number] = pixels
