"""Opens the camera of a cell by its kind."""

from __future__ import annotations

from q2r2_control.cameras.device import CameraDevice, check_installed
from q2r2_control.config.recording import CameraConfig


def open_device(camera: CameraConfig) -> CameraDevice:
    """Open a camera. After its pictures are turned by ``camera.rotation``, they have the size that the cell says.

    Raises:
        CameraError: If the camera cannot be opened with the cell's settings. The message says why. It does not name the
            camera.
    """
    check_installed(camera)
    if camera.device_kind == "file":
        # This import is not at the top of the file, so that only the process of a camera imports OpenCV.
        from q2r2_control.cameras.video_file import VideoFile

        return VideoFile(camera)
    if camera.device_kind == "realsense":
        from q2r2_control.cameras.realsense import open_realsense

        return open_realsense(camera)
    from q2r2_control.cameras.opencv_device import OpenCvDevice

    return OpenCvDevice(camera)
