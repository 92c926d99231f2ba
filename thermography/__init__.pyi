from .common import ThermographyError
from .evaluation import (
    count_temperatures,
    evaluate_regions,
    find_isotherm,
    read_profile,
    subtract_frames,
    thermogram,
)
from .fields.hotspots import detect_hotspots, region_series
from .fields.moving import reduce_moving_frames
from .fields.still import reduce_frames
from .inspection import inspect_file
from .io.flir import index_frames, read_frame
from .io.flir_writer import write_jpeg, write_sequence
from .io.frame import CameraParameters
from .io.other_cameras import StackOptions, index_recordings
from .io.region import Region
from .pictures import draw_thermogram, export_frames
from .plots import plot_field
from .radiometry.planck import calibrate
from .radiometry.uncertainty import temperature_uncertainty
from .registration.plan import PlanGrid, read_fiducials
from .registration.register import register

__all__ = [
    "CameraParameters",
    "PlanGrid",
    "Region",
    "StackOptions",
    "ThermographyError",
    "calibrate",
    "count_temperatures",
    "detect_hotspots",
    "draw_thermogram",
    "evaluate_regions",
    "export_frames",
    "find_isotherm",
    "index_frames",
    "index_recordings",
    "inspect_file",
    "plot_field",
    "read_fiducials",
    "read_frame",
    "read_profile",
    "reduce_frames",
    "reduce_moving_frames",
    "region_series",
    "register",
    "subtract_frames",
    "temperature_uncertainty",
    "thermogram",
    "write_jpeg",
    "write_sequence",
]
