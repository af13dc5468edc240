"""Scenes and their labels: render a composed scene and say what is known of each object in it.

An image does not change when an object's size and distance grow together. Scenes are composed in units of their own
(see `nolbo_ppl.synthetic.scenes.scene_sampler`), and the labels are the same objects scaled about the camera to their real size:
rotation, size and position of each label agree exactly with the perspective of its pixels, while distances between
different objects of a scene are not those of one real place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from nolbo_ppl.errors import input_error
from nolbo_ppl.structures.annotations import Annotations
from nolbo_ppl.synthetic.assets.shape_library import ShapeAsset
from nolbo_ppl.synthetic.renderer.camera_view import MeshInstance, View
from nolbo_ppl.synthetic.renderer.lens import LOSSLESS, compressed, motion_blurred, vignetted
from nolbo_ppl.synthetic.renderer.ray_casting import Hits, average_down, image_window, shade, to_display, trace


@dataclass(frozen=True)
class SceneObject:
    """One labelled object of a scene, in the scene's units."""

    R_camera_object: Float[np.ndarray, "3 3"]
    centre: Float[np.ndarray, " 3"]
    """Box centre in the camera frame, scene units."""
    diagonal: float
    """Box diagonal, scene units."""
    item: ShapeAsset
    """What it was drawn from."""


@dataclass(frozen=True)
class Scene:
    """Everything needed to render one image."""

    view: View
    objects: tuple[SceneObject, ...]
    exposure: float
    blur: float
    noise: float
    noise_seed: int
    supersample: int
    least_visibility: float
    least_box: float
    motion: tuple[float, float] = (0.0, 0.0)
    """Path (x, y) of the camera during the exposure, px."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners."""
    jpeg_quality: int = LOSSLESS


@dataclass(frozen=True)
class ObjectLabel:
    """What is known of one object of an image."""

    category: str
    instance: str
    box: Float[np.ndarray, " 4"]
    """Tight box [x0, y0, x1, y1] px of the whole (amodal) silhouette: of the projected vertices, cut to the image."""
    R_camera_object: Float[np.ndarray, "3 3"]
    """Egocentric rotation."""
    position: Float[np.ndarray, " 3"]
    """Box centre in the camera frame, m."""
    size: float
    """Box diagonal, m."""
    dimensions: Float[np.ndarray, " 3"]
    """Side lengths of the box along the object's axes, m."""
    visibility: float
    """Pixels seen over pixels of the silhouette without anything before it, its part beyond the border included."""
    symmetry: int
    item: ShapeAsset
    """The shape, with the number of the instance in its pool."""


@dataclass(frozen=True)
class Rendered:
    """An image with its labels, and what only the renderer knows."""

    annotations: Annotations
    """The image and its labels."""
    assets: tuple[ShapeAsset, ...]
    """Shape of each object."""
    instance_id: Int[np.ndarray, "h w"]
    """Number of the label each pixel shows, or -1 (at the first ray of the pixel)."""

    @classmethod
    def from_labels(
        cls,
        image: UInt8[np.ndarray, "h w 3"],
        intrinsics: Float[np.ndarray, " 4"],
        labels: Sequence[ObjectLabel],
        instance_id: Int[np.ndarray, "h w"],
        ids: Sequence[str] | None = None,
    ) -> Rendered:
        """Of an image and its objects one by one; `ids` are their names in a sequence."""
        annotations = Annotations.from_arrays(
            intrinsics,
            np.array([label.box for label in labels]).reshape(-1, 4),
            category=[label.category for label in labels],
            instance=[label.instance for label in labels],
            id=ids,
            R_camera_object=[label.R_camera_object for label in labels],
            position=[label.position for label in labels],
            diagonal=[label.size for label in labels],
            dimensions=[label.dimensions for label in labels],
            visibility=[label.visibility for label in labels],
            symmetry=[label.symmetry for label in labels],
            pixels=image,
        )
        return cls(annotations, tuple(label.item for label in labels), instance_id)

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The image."""
        return self.annotations.image

    @property
    def intrinsics(self) -> Float[np.ndarray, " 4"]:
        """[fx, fy, cx, cy], px."""
        return self.annotations.intrinsics

    @property
    def numbers(self) -> list[int]:
        """Number of each object's shape in its library."""
        return [asset.number for asset in self.assets]

    @property
    def labels(self) -> tuple[ObjectLabel, ...]:
        """The annotations row by row, for those who look at one object."""
        seen = self.annotations
        return tuple(
            ObjectLabel(
                category=asset.shape.category,
                instance=asset.shape.instance,
                box=seen.box[k],
                R_camera_object=seen.R_camera_object[k],
                position=seen.position[k],
                size=float(seen.diagonal[k]),
                dimensions=seen.dimensions[k],
                visibility=float(seen.visibility[k]),
                symmetry=int(seen.symmetry[k]),
                item=asset,
            )
            for k, asset in enumerate(self.assets)
        )

    def with_voxels(self) -> Annotations:
        """The annotations with the shapes' packed voxels."""
        n = len(self.assets)
        voxels = np.array([asset.voxels for asset in self.assets], dtype=np.uint8).reshape(n, -1 if n else 0)
        return replace(self.annotations, voxels=voxels)


def amodal_box(placed: MeshInstance, view: View) -> Float[np.ndarray, " 4"]:
    """Tight box of the projected vertices, cut to the image."""
    window = image_window(placed, view.intrinsics)
    if window is None:
        raise input_error("object behind the camera", got=placed.offset.tolist(), expected="every vertex at z > 0")
    return np.clip(window, 0, [view.width, view.height, view.width, view.height])


def _fine(view: View, factor: int) -> View:
    """The same view with `factor` times as many rays along each side."""
    if factor == 1:
        return view
    return replace(
        view,
        height=view.height * factor,
        width=view.width * factor,
        intrinsics=view.intrinsics * factor,
        backdrop=replace(view.backdrop, picture=_enlarge(view.backdrop.picture, factor)),
    )


def _enlarge(picture: np.ndarray | None, factor: int) -> np.ndarray | None:
    return None if picture is None else picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _seen_objects(scene: Scene, view: View) -> tuple[View, Hits, dict[int, float]]:
    """Take objects that are hardly seen out of the view, until all that remain are seen; also their visibilities."""
    while True:
        hits = trace(view)
        visibility, gone = {}, set()
        for placed in view.placed:
            if placed.instance_id < 0:
                continue
            covered = hits.instance_silhouette[placed.instance_id]
            visibility[placed.instance_id] = hits.instance_visible[placed.instance_id] / covered if covered else 0.0
            box = amodal_box(placed, scene.view)
            side = min(box[2] - box[0], box[3] - box[1])
            if visibility[placed.instance_id] < scene.least_visibility or side < scene.least_box:
                gone.add(placed.instance_id)
        if not gone:
            return view, hits, visibility
        view = replace(view, placed=tuple(p for p in view.placed if p.instance_id < 0 or p.instance_id not in gone))


def _blurred(colour: np.ndarray, scale: float) -> np.ndarray:
    """Gaussian blur of a small scale (px): five taps along each axis."""
    if scale < 0.2:
        return colour
    weight = np.exp(-0.5 * (np.arange(-2, 3) / scale) ** 2).astype(np.float32)
    weight /= weight.sum()
    height, width = colour.shape[:2]
    padded = np.pad(colour, ((2, 2), (2, 2), (0, 0)), mode="edge")
    rows = sum(w * padded[k : k + height] for k, w in enumerate(weight))
    return sum(w * rows[:, k : k + width] for k, w in enumerate(weight))


def render_scene(scene: Scene) -> Rendered:
    """Render a scene and label every object that is seen in it.

    Objects of which too little is seen (`SceneConfig.least_visibility`, `least_box`) are taken out of the scene before
    it is shaded, so that no image shows an object that its labels lack.
    """
    factor = scene.supersample
    view, hits, visibility = _seen_objects(scene, _fine(scene.view, factor))
    colour = _blurred(average_down(shade(view, hits), factor), scene.blur)
    colour = vignetted(motion_blurred(colour, np.array(scene.motion)), scene.vignetting)
    noise = np.random.default_rng(scene.noise_seed).standard_normal(colour.shape, dtype=np.float32)
    image = compressed(to_display(colour, scene.exposure, np.float32(scene.noise) * noise), scene.jpeg_quality)
    labels: list[ObjectLabel] = []
    number = np.full(len(view.placed) + 1, -1)
    for k, placed in enumerate(view.placed):
        if placed.instance_id < 0:
            continue
        number[k] = len(labels)
        labels.append(_label(scene.objects[placed.instance_id], amodal_box(placed, scene.view), visibility[placed.instance_id]))
    instance_id = number[hits.index[::factor, ::factor]]
    return Rendered.from_labels(image, scene.view.intrinsics, labels, instance_id)


def _label(thing: SceneObject, box: np.ndarray, visibility: float) -> ObjectLabel:
    shape = thing.item.shape
    return ObjectLabel(
        category=shape.category,
        instance=shape.instance,
        box=box,
        R_camera_object=thing.R_camera_object,
        position=thing.centre * (shape.diagonal / thing.diagonal),
        size=shape.diagonal,
        dimensions=shape.dimensions,
        visibility=min(1.0, visibility),
        symmetry=shape.symmetry,
        item=thing.item,
    )
