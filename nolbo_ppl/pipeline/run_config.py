"""Options of a run, each with the first stage whose result it changes (`stage_keys`)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.odometry import OdometryConfig
from nolbo_ppl.pipeline.stage_keys import affects
from nolbo_ppl.renamed_options import renamed_options


@renamed_options(
    every="frame_stride",
    wheel="step_lengths",
    sizes="test_sizes",
    threshold="score_threshold",
    overlap="nms_iou_threshold",
    loop_gap="min_loop_gap",
)
@dataclass(frozen=True)
class RunConfig:
    """From images to a corrected trajectory, a map of objects with shapes, figures and a report.

    Example:
        >>> import nolbo_ppl
        >>> config = nolbo_ppl.RunConfig("drive/images", "run", intrinsics="drive/intrinsics.json", camera_height=1.5)
        >>> config.score_threshold
        0.6
    """

    images: Path = field(metadata=affects("odometry", "images"))
    """Folder of images (plain, KITTI or TUM), a video file, or a bag of ROS (extra `ros`): of it, odometry, truth, intrinsics
    and depth are named by `BAG:/topic`."""
    out: Path = field(metadata=affects(None))
    """Folder of the run. Stages that are complete in it are not done again."""
    intrinsics: Path | None = field(default=None, metadata=affects("odometry", "file"))
    """The camera: YAML of OpenCV, ROS, Kalibr or ORB-SLAM, JSON with fx, fy, cx, cy in px of the images, a KITTI calib.txt, or
    numbers. Its distortion is taken out of the images. Without a file the camera is guessed, which makes ranges wrong."""
    odometry: Path | None = field(default=None, metadata=affects("odometry", "file"))
    """Odometry of every image, T_world_camera (KITTI or TUM rows); without it visual odometry is run."""
    truth: Path | None = field(default=None, metadata=affects("odometry", "file"))
    """True trajectory, for errors, and for the lengths of visual odometry where nothing else gives them."""
    truth_objects: Path | None = field(default=None, metadata=affects("figures", "drive"))
    """Folder of a drive (`nolbo drive`), for figures against its true objects."""
    model: str = field(default="photo", metadata=affects("observe", "model"))
    """Observation model: `photo` for pictures of the world, `tiny` for generated drives, or a folder."""
    device: str = field(default="auto", metadata=affects(None))
    """Where its networks run: `auto`, `cpu`, `cuda`, `cuda:N` or `mps`."""
    online: bool = field(default=False, metadata=affects("slam"))
    """Run keyframe by keyframe on iSAM2 instead of in one batch."""
    scale_drift: bool = field(default=False, metadata=affects("slam"))
    """The odometry's unit of length is unknown and wanders, as a single camera's does: its scale is estimated at every step.
    The same as `--slam.scale-drift`."""
    camera_height: float | None = field(default=None, metadata=affects("odometry"))
    """Height of the camera over the ground, m: gives visual odometry its scale."""
    camera_pitch: float = field(default=0.0, metadata=affects("odometry"))
    """How far that camera looks down, rad."""
    step_lengths: Path | None = field(default=None, metadata=affects("odometry", "file"))
    """Length of each step between images, m, a number a line: gives visual odometry its scale."""
    frame_stride: int = field(default=1, metadata=affects("odometry"))
    """Use every so many-th image."""
    keyframe_distance: float = field(default=0.0, metadata=affects("odometry"))
    """Of those, keep one this far from the last, m; with `keyframe_angle` 0 as well, all are kept."""
    keyframe_angle: float = field(default=0.0, metadata=affects("odometry"))
    """Or turned by this much, rad."""
    test_sizes: tuple[int, ...] = field(default=(576,), metadata=affects("observe"))
    """Longer sides, px, at which the model looks at each image: one for pictures like those it was trained on, more where
    near objects are many times larger than far ones."""
    score_threshold: float = field(default=0.6, metadata=affects("observe"))
    """Least objectness of a detection."""
    nms_iou_threshold: float = field(default=0.2, metadata=affects("observe"))
    """Overlap (IoU) above which two regions of an image describe one object: the less certain one goes. Two regions on one
    object would be two landmarks; of two objects so close in one image another image shows the second."""
    batch: int = field(default=16, metadata=affects(None))
    """Images that go through the network at once."""
    depth: Path | None = field(default=None, metadata=affects("odometry", "folder"))
    """Folder of depth pictures (16 bit PNG, same names or same order as the images), registered to them, or `BAG:/topic`: refine
    positions, and give visual odometry metric steps where neither height nor wheel does. A lens' distortion is taken out of
    them as well."""
    depth_unit: float = field(default=1 / 5000, metadata=affects("odometry"))
    """Metres of one step of them: TUM 1/5000, YCB-Video 1/10000, millimetres 1/1000."""
    right: Path | None = field(default=None, metadata=affects("odometry", "folder"))
    """Folder of the right images of a rectified stereo pair: refine positions, and give visual odometry metric steps."""
    baseline: float | None = field(default=None, metadata=affects("odometry"))
    """Distance of the two cameras, m."""
    usual_heights: Literal["auto", "on", "off"] = field(default="auto", metadata=affects("observe"))
    """Real objects: refine positions by the usual heights of their categories (cars 1.5 m), where there is no depth. The weights
    `photo` know ranges from generated scenes; those of KITTI's cars are off by a quarter without this, by a twentieth with it,
    and the same error in all views of a car bends the trajectory. `auto`: for these weights alone."""
    mcap: bool = field(default=False, metadata=affects("map"))
    """Also write trajectory and map as map.mcap, for Foxglove and rviz (extra `ros`)."""
    report: bool = field(default=True, metadata=affects(None))
    """Write report.html."""
    min_loop_gap: int = field(default=50, metadata=affects("figures"))
    """Detections further apart than this many keyframes make a loop pair, in the figures."""
    seed: int = field(default=0, metadata=affects("figures"))
    """Seed of the samples of the landmarks' shapes, and of the views drawn for the figures."""
    visual: OdometryConfig = field(default_factory=OdometryConfig, metadata=affects("odometry"))
    """Settings of the visual odometry."""
    slam: SlamConfig = field(default_factory=SlamConfig, metadata=affects("slam"))
    """Settings of the EM."""
    topic: str | None = field(default=None, metadata=affects("odometry"))
    """Topic of the images of a bag; by default its only one. Its camera info gives the camera."""

    @property
    def refines_by_height(self) -> bool:
        """Whether usual heights refine positions."""
        return self.usual_heights == "on" or (self.usual_heights == "auto" and self.model == "photo")

    def __post_init__(self) -> None:
        if self.scale_drift and not self.slam.scale_drift:
            object.__setattr__(self, "slam", dataclasses.replace(self.slam, scale_drift=True))
        if self.frame_stride < 1:
            raise input_error("--frame-stride", got=self.frame_stride, expected="at least 1")
        if not 0 < self.score_threshold < 1:
            raise input_error("--score-threshold", got=self.score_threshold, expected="a probability between 0 and 1")
        if not 0 < self.nms_iou_threshold <= 1:
            raise input_error("--nms-iou-threshold", got=self.nms_iou_threshold, expected="an overlap above 0, up to 1")
        if min(self.keyframe_distance, self.keyframe_angle) < 0:
            raise input_error("spacing of keyframes", got=(self.keyframe_distance, self.keyframe_angle), expected="0 or more")
        if not self.test_sizes or min(self.test_sizes) < 32:
            raise input_error("--test-sizes", got=self.test_sizes, expected="at least one, none under 32 px")
        if self.batch < 1:
            raise input_error("--batch", got=self.batch, expected="at least 1")
        if self.depth is not None and self.right is not None:
            raise input_error("--depth and --right", got="both", expected="one of the two")
        if (self.right is None) != (self.baseline is None):
            raise input_error("a stereo pair", got="--right or --baseline alone", expected="both")
        if self.baseline is not None and not self.baseline > 0:
            raise input_error("--baseline", got=self.baseline, expected="a distance in m")
        if not (np.isfinite(self.depth_unit) and self.depth_unit > 0):
            raise input_error("--depth-unit", got=self.depth_unit, expected="metres of one step, above 0")
        if self.camera_height is not None and self.step_lengths is not None:
            raise input_error("--camera-height and --step-lengths", got="both", expected="one source of lengths")
