"""Guide and decoder as ONNX files, for programs without torch: a graph from pixels to the posterior, one from latents to voxels.

The guide's graph answers for the `candidates` likeliest regions of one image, the RoI refinement included, with calibrated scales
and in the units of `ObjectPosteriors`; which of them describe one object (suppression) is left to who runs it
(docs/howto/without-torch.md).
"""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.rotation import allocentric_to_egocentric, viewpoint_to_matrix
from nolbo_ppl.inference.posterior.decode import box_sigmas, position_covariance
from nolbo_ppl.inference.posterior.metric_size import MetricKnowledge, with_metric_size
from nolbo_ppl.inference.posterior.predictor import ObservationModel
from nolbo_ppl.io.files import atomic_path, write_json
from nolbo_ppl.models.distributions import VonMisesMixture
from nolbo_ppl.models.hybrid_guide import HybridGuide
from nolbo_ppl.models.image_shift import ODDS_PER_SHIFT, SCALE_PER_SHIFT, excess
from nolbo_ppl.models.scene_batch import decode_box, decode_range

OPSET = 18
"""Version of ONNX's operators: the first with reductions when scattering."""
FORMAT = 1
"""Of the folder."""
OUTPUTS = (
    "region", "objectness", "box", "box_scale", "class_log_posterior", "latent", "latent_scale", "azimuth_weights", "azimuth",
    "azimuth_concentration", "elevation_inplane", "elevation_inplane_scale", "position", "position_covariance", "diagonal",
    "diagonal_log_scale", "R_camera_object", "rotation_scale",
)  # fmt: skip
"""What the guide's graph gives, a row a candidate, best objectness first: the number of the region, then what `ObjectPosteriors`
has under the same names, in its units and frames."""


@dataclass(frozen=True)
class ExportedFiles:
    """What was written."""

    guide: Path
    """Image and intrinsics to the posterior of the likeliest regions."""
    decoder: Path
    """Shape latents to occupancy probabilities."""
    description: Path
    """JSON: categories, prior means, size of the image, meaning of every output."""


class GuideGraph(nn.Module):
    """The guide on one image, as one function of tensors alone.

    Args:
        model: the observation model, on the CPU.
        candidates: regions that are answered for.
    """

    def __init__(self, model: ObservationModel, candidates: int) -> None:
        super().__init__()
        self.guide, self.config, self.calibration = model.model.guide, model.config, model.calibration
        self.candidates = candidates
        self.register_buffer("prior_mean", torch.from_numpy(model.prior_mean()))
        self.hulls = model._shape_hulls if isinstance(self.guide, HybridGuide) else None

    def forward(
        self, image: Float[Tensor, "1 3 h w"], intrinsics: Float[Tensor, " 4"], extent: Float[Tensor, " 2"] | None = None
    ) -> tuple[Tensor, ...]:
        """The posterior of the likeliest regions, in the order of `OUTPUTS`.

        Args:
            image: colours 0..255.
            intrinsics: [fx, fy, cx, cy], px of this image.
            extent: width and height, px, of the picture in it, without grey bars; for models with a detector.
        """
        config = self.config
        encoding = self.guide.encode(image)
        odds = self.calibration.objectness(encoding.objectness_logit[0])
        if encoding.shift is not None:
            odds = odds - ODDS_PER_SHIFT * excess(encoding.shift)
        logit, region = odds.topk(self.candidates)
        row = torch.zeros_like(region)
        q = self.guide.parameters_at(encoding, row, region)
        q = self.calibration.apply(q.at_map_category(self.get_buffer("prior_mean")))
        if encoding.shift is not None:
            q = q.widened(1 + SCALE_PER_SHIFT * excess(encoding.shift)[row])
        camera = intrinsics.expand(self.candidates, 4)
        box = decode_box(q.box_loc, region // config.predictors, encoding.columns, config)
        box_scale = box_sigmas(q, config)
        position, diagonal = decode_range(q.range_loc, box, camera, config)
        azimuth = VonMisesMixture(
            q.azimuth_logits, q.azimuth_natural, max_concentration=config.max_concentration, validate_args=False
        )
        mean, weight, concentration = azimuth.component_mean, azimuth.weights, azimuth.concentration
        viewpoint = torch.cat((_polished(azimuth, azimuth.find_mode(grid=90))[:, None], q.angle_loc), -1)
        best = (mean - viewpoint[:, :1]).cos().argmax(-1, keepdim=True)
        variance = 1 / concentration.gather(-1, best)[:, 0].clamp_min(0.1)
        R = allocentric_to_egocentric(viewpoint_to_matrix(viewpoint), position)
        if self.hulls is not None and extent is not None and encoding.generated is not None:
            assert isinstance(self.guide, HybridGuide)
            share, guessed = 1 - encoding.generated[row], torch.zeros_like(region).bool()
            known = MetricKnowledge(self.hulls, self.guide.sizes, share, guessed, extent.expand(self.candidates, 2))
            q = with_metric_size(q, box, position, diagonal, R, camera, known, config)
            position, diagonal = decode_range(q.range_loc, box, camera, config)
        return (
            region,
            torch.sigmoid(logit),
            box,
            box_scale,
            torch.log_softmax(q.label_logits, -1),
            q.shape_loc,
            q.shape_scale,
            weight,
            mean,
            concentration,
            q.angle_loc,
            q.angle_scale,
            position,
            position_covariance(q, box, box_scale, position, camera, config).to(box.dtype),
            diagonal,
            q.range_scale[:, 3] * config.range_spread[3],
            R,
            ((variance + q.angle_scale.square().sum(-1)) / 3).sqrt(),
        )


def _polished(azimuth: VonMisesMixture, mode: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """A mode after three plain Newton steps: in single precision densities about it are equal over 3e-4 rad, slopes are not."""
    for _ in range(3):
        slope, curvature = azimuth._derivatives(mode)
        step = torch.where(curvature < 0, -slope / curvature.clamp_max(-1e-6), torch.zeros_like(mode))
        mode = mode + step.clamp(-0.02, 0.02)
    return mode


class DecoderGraph(nn.Module):
    """Latents to the probability of every voxel."""

    def __init__(self, model: ObservationModel) -> None:
        super().__init__()
        self.decoder = model.model.story.decoder

    def forward(self, latent: Float[Tensor, "n d"]) -> Float[Tensor, "n v v v"]:
        """Occupancy probability of the canonical grid."""
        return torch.sigmoid(self.decoder(latent))


def export_onnx(
    model: ObservationModel, out: str | PathLike[str], size: tuple[int, int] | None = None, candidates: int = 64
) -> ExportedFiles:
    """Write `guide.onnx`, `decoder.onnx` and `model.json`.

    Args:
        model: what to export; its networks stay as they are.
        out: folder.
        size: width and height, px, of the images the graph takes, multiples of 32; a square of the network's own side by default.
        candidates: regions that are answered for, those of the greatest objectness.

    Raises:
        InputError: a size that is no multiple of 32, no candidates or more than there are regions, a model of single objects, or
            `onnx` is not installed.
    """
    try:
        import onnx  # noqa: F401 - what torch writes with
    except ImportError:
        raise input_error("export to ONNX", got="no package `onnx`", do="pip install 'nolbo-ppl[onnx]'") from None
    config = model.config
    if config.description.one_object:
        raise input_error("export to ONNX", got="a model of single objects", expected="a model of whole scenes")
    width, height = (config.image_size, config.image_size) if size is None else size
    if width <= 0 or height <= 0 or width % 32 or height % 32:
        raise input_error("size of the images", got=(width, height), expected="positive multiples of 32")
    regions = (width // config.stride) * (height // config.stride) * config.predictors
    if not 1 <= candidates <= regions:
        raise input_error("candidates", got=candidates, expected=f"1 to {regions} regions of {width} x {height} px")
    plain = ObservationModel(copy.deepcopy(model.model).cpu().float(), model.calibration)
    plain.model.set_half_precision(False)
    out = Path(out)
    image = torch.full((1, 3, height, width), 114.0, dtype=torch.float32, device="cpu")
    camera = torch.tensor([width, width, width / 2, height / 2], dtype=torch.float32, device="cpu")
    latent = torch.zeros(2, config.latent_dim, dtype=torch.float32, device="cpu")
    files = ExportedFiles(out / "guide.onnx", out / "decoder.onnx", out / "model.json")
    inputs, names = (image, camera), ["image", "intrinsics"]
    if config.detector:
        inputs, names = (*inputs, camera.new_tensor([width, height])), [*names, "extent"]  # type: ignore[assignment]
    _write(GuideGraph(plain, candidates), inputs, files.guide, names, list(OUTPUTS), {})
    axes = {"latent": {0: "objects"}, "occupancy": {0: "objects"}}
    _write(DecoderGraph(plain), (latent,), files.decoder, ["latent"], ["occupancy"], axes)
    description = {
        "format": FORMAT,
        "width": width,
        "height": height,
        "padding": 114,
        "candidates": candidates,
        "categories": list(config.categories),
        "symmetry": list(config.symmetry),
        "latent_dim": config.latent_dim,
        "voxel_size": config.voxel_size,
        "one_region_an_object": not config.detector,
        "objectness_limit": plain.calibration.objectness_limit,
        "prior_mean": plain.prior_mean().tolist(),
        "guide_inputs": names,
        "inputs": {
            "image": "float32 [1, 3, height, width], RGB 0..255; scaled uniformly, grey bars right and below",
            "intrinsics": "float32 [4], fx fy cx cy in px of the scaled image",
            "extent": "float32 [2], width and height in px of the picture in the image, without its bars",
            "latent": "float32 [n, latent_dim]",
        },
        "outputs": [*OUTPUTS, "occupancy"],
    }
    write_json(files.description, description)
    return files


def _write(
    graph: nn.Module, inputs: tuple[Tensor, ...], file: Path, names: list[str], outputs: list[str], axes: dict[str, Any]
) -> None:
    """Trace a graph into a file, whole or not at all."""
    default = torch.get_default_dtype()
    with atomic_path(file) as temporary, torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of tracing: shapes are those of one size of image, on purpose
        torch.set_default_dtype(torch.float32)
        try:
            # The newer exporter needs another package, and fails on graphs that choose regions by their values.
            torch.onnx.export(
                graph.eval(),
                inputs,
                str(temporary),
                input_names=names,
                output_names=outputs,
                dynamic_axes=axes,
                opset_version=OPSET,
                dynamo=False,
            )
        finally:
            torch.set_default_dtype(default)
