"""One frame of a drive: what the camera sees from its pose, and the labels of the objects in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from nolbo_ppl.geometry.pose import inverse
from nolbo_ppl.io.scenes import annotations_record
from nolbo_ppl.synthetic.renderer.antialias import shade_smoothly
from nolbo_ppl.synthetic.renderer.camera_view import Light, MeshInstance, View
from nolbo_ppl.synthetic.renderer.ray_casting import to_display, trace
from nolbo_ppl.synthetic.scenes.render_scene import ObjectLabel, Rendered, amodal_box
from nolbo_ppl.synthetic.worlds.placing import WorldObject
from nolbo_ppl.synthetic.worlds.world import World

MIN_PIXELS = 3.0
"""Objects whose box diagonal projects to fewer px are not drawn."""
SHADOW_REACH = 2.0
"""Objects out of sight whose ball, grown by this many of its radii, meets the view still throw their shadows."""


@dataclass(frozen=True)
class RenderedFrame:
    """An image with its labels, and which objects they name."""

    rendered: Rendered

    @property
    def ids(self) -> tuple[str | None, ...]:
        """Object of each label."""
        return self.rendered.annotations.id

    def record(self, image: str) -> dict[str, Any]:
        """The line of `scenes.jsonl`."""
        return annotations_record(self.rendered.annotations, image)


def _reach(point: np.ndarray, radius: float, intrinsics: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether a ball meets the camera's field of view."""
    if point[2] < -radius:
        return False
    for axis in (0, 1):
        slope = size[axis] / 2 / intrinsics[axis]
        if (abs(point[axis]) - slope * point[2]) / np.hypot(1, slope) > radius:
            return False
    return True


def frame_view(world: World, frame: int) -> tuple[View, tuple[WorldObject, ...]]:
    """What a camera frame shows, and the object of each instance id."""
    config, T_ground_camera = world.config, world.T_ground_camera[frame]
    T_camera_ground = inverse(T_ground_camera)
    R, t = T_camera_ground[:3, :3], T_camera_ground[:3, 3]
    placed = [MeshInstance(world.static, R, t, world.static_materials, -1, config.seed & 0xFFFF, config.world == "street")]
    shown: list[WorldObject] = []
    for thing in world.objects:
        diagonal = thing.look.item.shape.diagonal
        pose = world.T_ground_object(thing, frame) if thing.moving else thing.T_ground_object
        centre = R @ pose[:3, 3] + t
        if diagonal * world.intrinsics[0] < MIN_PIXELS * max(float(np.linalg.norm(centre)), 0.1):
            continue
        if not _reach(centre, 0.5 * SHADOW_REACH * diagonal, world.intrinsics, config.size):
            continue
        linear = R @ pose[:3, :3] * diagonal
        placed.append(MeshInstance(thing.look.item.mesh, linear, centre, thing.look.materials, len(shown), thing.look.seed))
        shown.append(thing)
    lights = tuple(Light(R @ light.direction, light.colour, light.shadow) for light in world.lights)
    width, height = config.size
    view = View(
        height=height,
        width=width,
        intrinsics=world.intrinsics,
        up=R[:, 2],
        north=R[:, 1],
        camera_height=float(T_ground_camera[2, 3]),
        placed=tuple(placed),
        lights=lights,
        ambient_sky=world.ambient_sky,
        ambient_ground=world.ambient_ground,
        backdrop=replace(world.backdrop, R_sky_camera=R.T),
    )
    return view, tuple(shown)


def render_frame(world: World, frame: int) -> RenderedFrame:
    """Render one frame and label the objects that are seen in it; depends on the world and the number alone.

    Objects are labelled when their visibility and box reach `SequenceConfig.least_visibility` and `least_box`, and they lie
    wholly before the camera; all others stay in the picture without a label.
    """
    config = world.config
    view, shown = frame_view(world, frame)
    hits = trace(view)
    colour = shade_smoothly(view, hits, config.supersample)
    noise = np.random.default_rng([config.seed, 9200, frame]).standard_normal(colour.shape, dtype=np.float32)
    image = to_display(colour, world.exposure, np.float32(config.noise) * noise)
    labels: list[ObjectLabel] = []
    ids: list[str] = []
    number = np.full(len(view.placed) + 1, -1)
    for k, placed in enumerate(view.placed):
        if placed.instance_id < 0 or placed.vertices[:, 2].min() < 0.05:
            continue
        visible, covered = hits.instance_visible[placed.instance_id], hits.instance_silhouette[placed.instance_id]
        visibility = visible / covered if covered else 0.0
        box = amodal_box(placed, view)
        if visibility < config.least_visibility or min(box[2] - box[0], box[3] - box[1]) < config.least_box:
            continue
        number[k] = len(labels)
        labels.append(_label(shown[placed.instance_id], placed, box, visibility))
        ids.append(shown[placed.instance_id].id)
    instance_id = number[hits.index]
    return RenderedFrame(Rendered.from_labels(image, world.intrinsics, labels, instance_id, ids))


def _label(thing: WorldObject, placed: MeshInstance, box: Float[np.ndarray, " 4"], visibility: float) -> ObjectLabel:
    item = thing.look.item
    return ObjectLabel(
        category=item.shape.category,
        instance=item.shape.instance,
        box=box,
        R_camera_object=placed.linear / item.shape.diagonal,
        position=placed.offset,
        size=item.shape.diagonal,
        dimensions=item.shape.dimensions,
        visibility=min(1.0, visibility),
        symmetry=item.shape.symmetry,
        item=item,
    )
