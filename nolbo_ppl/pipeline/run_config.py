"""Options of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from nolbo_ppl.errors import input_error
from nolbo_ppl.inference.slam import SlamConfig
from nolbo_ppl.odometry import OdometryConfig


@dataclass(frozen=True)
class RunConfig:
    """From images to a corrected trajectory, a map of objects with shapes, figures and a report."""

    images: Path
    """Folder of images (plain, KITTI or TUM), or a video file."""
    out: Path
    """Folder of the run. Stages that are complete in it are not done again."""
    intrinsics: Path | None = None
    """The camera: YAML of OpenCV, ROS, Kalibr or ORB-SLAM, JSON with fx, fy, cx, cy in px of the images, a KITTI calib.txt, or
    numbers. Its distortion is taken out of the images. Without a file the camera is guessed, which makes ranges wrong."""
    odometry: Path | None = None
    """Odometry of every image, T_world_camera (KITTI or TUM rows); without it visual odometry is run."""
    truth: Path | None = None
    """True trajectory, for errors, and for the lengths of visual odometry where nothing else gives them."""
    truth_objects: Path | None = None
    """Folder of a drive (`nolbo drive`), for figures against its true objects."""
    model: str = "tiny"
    """Observation model: name of weights in the package, or a folder."""
    online: bool = False
    """Run keyframe by keyframe on iSAM2 instead of in one batch."""
    camera_height: float | None = None
    """Height of the camera over the ground, m: gives visual odometry its scale."""
    camera_pitch: float = 0.0
    """How far that camera looks down, rad."""
    wheel: Path | None = None
    """Length of each step between images, m, a number a line: gives visual odometry its scale."""
    every: int = 1
    """Use every so many-th image."""
    keyframe_distance: float = 0.0
    """Of those, keep one this far from the last, m; with `keyframe_angle` 0 as well, all are kept."""
    keyframe_angle: float = 0.0
    """Or turned by this much, rad."""
    sizes: tuple[int, ...] = (576,)
    """Longer sides, px, at which the model looks at each image: one for pictures like those it was trained on, more where
    near objects are many times larger than far ones."""
    threshold: float = 0.6
    """Least objectness of a detection."""
    overlap: float = 0.2
    """Overlap (IoU) above which two regions of an image describe one object: the less certain one goes. Two regions on one
    object would be two landmarks; of two objects so close in one image another image shows the second."""
    batch: int = 16
    """Images that go through the network at once."""
    depth: Path | None = None
    """Folder of depth pictures (16 bit PNG, same names or same order as the images): refine positions."""
    depth_unit: float = 1 / 5000
    """Metres of one step of them: TUM 1/5000, YCB-Video 1/10000, millimetres 1/1000."""
    right: Path | None = None
    """Folder of the right images of a rectified stereo pair: refine positions."""
    baseline: float | None = None
    """Distance of the two cameras, m."""
    report: bool = True
    """Write report.html."""
    loop_gap: int = 50
    """Detections further apart than this many keyframes make a loop pair, in the figures."""
    seed: int = 0
    """Seed of the samples of the landmarks' shapes, and of the views drawn for the figures."""
    visual: OdometryConfig = field(default_factory=OdometryConfig)
    """Settings of the visual odometry."""
    slam: SlamConfig = field(default_factory=SlamConfig)
    """Settings of the EM."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise input_error("--every", got=self.every, expected="at least 1")
        if not 0 < self.threshold < 1:
            raise input_error("--threshold", got=self.threshold, expected="a probability between 0 and 1")
        if not 0 < self.overlap <= 1:
            raise input_error("--overlap", got=self.overlap, expected="an overlap above 0, up to 1")
        if min(self.keyframe_distance, self.keyframe_angle) < 0:
            raise input_error("spacing of keyframes", got=(self.keyframe_distance, self.keyframe_angle), expected="0 or more")
        if not self.sizes or min(self.sizes) < 32:
            raise input_error("--sizes", got=self.sizes, expected="at least one, none under 32 px")
        if self.batch < 1:
            raise input_error("--batch", got=self.batch, expected="at least 1")
        if self.depth is not None and self.right is not None:
            raise input_error("--depth and --right", got="both", expected="one of the two")
        if (self.right is None) != (self.baseline is None):
            raise input_error("a stereo pair", got="--right or --baseline alone", expected="both")
        if self.baseline is not None and not self.baseline > 0:
            raise input_error("--baseline", got=self.baseline, expected="a distance in m")
        if self.camera_height is not None and self.wheel is not None:
            raise input_error("--camera-height and --wheel", got="both", expected="one source of lengths")
