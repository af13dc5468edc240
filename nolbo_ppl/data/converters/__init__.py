"""Public data sets turned into odometry, truth and observations in the formats of `nolbo slam`, or into scenes."""

from __future__ import annotations

from nolbo_ppl.data.converters.converted import Converted, write_converted
from nolbo_ppl.data.converters.foreign_detections import observations_of, read_foreign_detections
from nolbo_ppl.data.converters.kitti_object import convert_kitti_drive, convert_kitti_object
from nolbo_ppl.data.converters.kitti_poles import convert_kitti_poles
from nolbo_ppl.data.converters.kitti_tracking import convert_kitti_tracking
from nolbo_ppl.data.converters.photographs import Photograph, convert_photographs, read_photographs
from nolbo_ppl.data.converters.ycbv_slam import convert_ycbv_slam

__all__ = [
    "Converted",
    "Photograph",
    "convert_kitti_drive",
    "convert_kitti_object",
    "convert_kitti_poles",
    "convert_kitti_tracking",
    "convert_photographs",
    "convert_ycbv_slam",
    "read_photographs",
    "observations_of",
    "read_foreign_detections",
    "write_converted",
]
