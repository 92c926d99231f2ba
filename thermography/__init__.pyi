from .common import ThermographyError
from .fields.hotspots import detect_hotspots, region_series
from .fields.moving import reduce_moving_frames
from .fields.still import reduce_frames
from .inspection import inspect_file
from .io.flir import index_frames, read_frame
from .io.flir_writer import write_jpeg, write_sequence
from .io.frame import CameraParameters
from .io.other_cameras import StackOptions, index_recordings
from .plots import plot_field
from .radiometry.planck import calibrate
from .radiometry.uncertainty import temperature_uncertainty
from .registration.plan import PlanGrid, read_fiducials
from .registration.register import register

__all__ = [
    "CameraParameters",
    "PlanGrid",
    "StackOptions",
    "ThermographyError",
    "calibrate",
    "detect_hotspots",
    "index_frames",
    "index_recordings",
    "inspect_file",
    "plot_field",
    "read_fiducials",
    "read_frame",
    "reduce_frames",
    "reduce_moving_frames",
    "region_series",
    "register",
    "temperature_uncertainty",
    "write_jpeg",
    "write_sequence",
]
