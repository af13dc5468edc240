"""Compose a random scene: camera, objects and clutter that stand without touching, light, backdrop.

The scene has its own units: each object gets the size at which it fills a wished number of pixels at its place, so that
a bottle and an aeroplane can stand side by side and every category shows at every pixel size and every elevation.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.synthetic.assets.shape_library import BLOCK, ShapeLibrary
from nolbo_ppl.synthetic.renderer.camera_view import Mesh, MeshInstance, View
from nolbo_ppl.synthetic.renderer.materials import Material, sample_material, sample_materials
from nolbo_ppl.synthetic.scenes import distractors as clutter
from nolbo_ppl.synthetic.scenes.background_images import BackgroundImages
from nolbo_ppl.synthetic.scenes.environment import daylight, sample_environment, sample_light
from nolbo_ppl.synthetic.scenes.footprint import Footprint
from nolbo_ppl.synthetic.scenes.occluders import sample_occluder
from nolbo_ppl.synthetic.scenes.render_scene import Scene, SceneObject
from nolbo_ppl.synthetic.scenes.scene_config import SceneConfig

CAMERA_HEIGHT = 1.0
"""The scene's unit of length."""
MAX_DISTANCE = 80.0
"""Greatest distance of a thing, in camera heights."""
MAX_ATTEMPTS = 12
"""Places tried for one thing before it is given up."""
R_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""R_camera_world of a level camera that looks along +y of a world with z up."""


def camera_rotation(tilt: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """R_camera_world of a camera tilted down and rolled, radians."""
    ct, st, cr, sr = np.cos(tilt), np.sin(tilt), np.cos(roll), np.sin(roll)
    R_tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    R_roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return R_roll @ R_tilt @ R_LEVEL


def _vertical(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


class _Composer:
    """Finds places: draws a pixel and a size, stands the thing on the ground there, refuses overlaps."""

    def __init__(self, config: SceneConfig, rng: np.random.Generator) -> None:
        self.config, self.rng, self.size = config, rng, config.size
        steep = rng.random() < config.steep_probability
        low, high = (config.elevation[1], config.steep_elevation) if steep else config.elevation
        roll = float(np.clip(rng.normal(), -3, 3)) * config.roll
        self.R_camera_world = camera_rotation(np.radians(rng.uniform(low, high)), np.radians(roll))
        focal = self.size * _log_uniform(rng, *config.focal)
        shift = rng.uniform(-1, 1, 2) * config.principal_point * self.size
        self.intrinsics = np.array([focal, focal, self.size / 2 + shift[0], self.size / 2 + shift[1]])
        self.up = self.R_camera_world[:, 2]
        self.footprints: list[Footprint] = []
        self.seen: list[tuple[np.ndarray, float]] = []

    def _pixel(self, pixels: float) -> np.ndarray:
        config, rng = self.config, self.rng
        if self.seen and rng.random() < config.near_probability:
            beside, other = self.seen[int(rng.integers(len(self.seen)))]
            offset = rng.normal(size=2) * 0.35 * (pixels + other)
            return np.clip(beside + offset, 0, self.size)
        margin = 0.0 if rng.random() < config.truncation_probability else min(0.45 * pixels, 0.42 * self.size)
        return rng.uniform(margin, self.size - margin, 2)

    def place(
        self, extents: np.ndarray, R_world_local: np.ndarray, pixel_range: tuple[float, float], flying: bool
    ) -> tuple[np.ndarray, float] | None:
        """Centre (camera frame) and diagonal for a thing with box side lengths `extents` (diagonal 1), or None.

        Its centre lies on the ray of a random pixel, at the distance where its underside touches the ground while its
        diagonal spans the wished pixels: `distance = height / (sin e + half_height * pixels / focal)`.
        """
        half_world = 0.5 * np.abs(R_world_local) @ extents
        for _ in range(MAX_ATTEMPTS):
            pixels = _log_uniform(self.rng, pixel_range[0], pixel_range[1] * self.size)
            pixel = self._pixel(pixels)
            ray = np.array([*((pixel - self.intrinsics[2:]) / self.intrinsics[:2]), 1.0])
            ray /= np.linalg.norm(ray)
            sine = -float(ray @ self.up)
            ratio = pixels / self.intrinsics[0]
            if flying:
                distance = float(_log_uniform(self.rng, 1.0, 20.0))
            else:
                reach = sine + half_world[2] * ratio
                if reach <= CAMERA_HEIGHT / MAX_DISTANCE or sine < np.sin(np.radians(self.config.least_elevation)):
                    continue
                distance = CAMERA_HEIGHT / reach
            diagonal, centre = ratio * distance, ray * distance
            if centre[2] < 0.7 * diagonal:
                continue
            world = self.R_camera_world.T @ centre
            z = (world[2] - half_world[2] * diagonal, world[2] + half_world[2] * diagonal)
            if flying and z[0] < -CAMERA_HEIGHT:
                continue
            axes = np.eye(2) if flying else R_world_local[:2, :2].T
            half = (half_world[:2] if flying else 0.5 * extents[:2]) * diagonal
            footprint = Footprint(world[:2], axes, half, z)
            if any(footprint.meets(other) for other in self.footprints):
                continue
            self.footprints.append(footprint)
            self.seen.append((pixel, pixels))
            return centre, diagonal
        return None


def _object(
    composer: _Composer, pool: ShapeLibrary, block: int, instance_id: int, config: SceneConfig, rng: np.random.Generator
) -> tuple[SceneObject, MeshInstance] | None:
    """Draw one labelled object and its place."""
    item = pool.draw(rng, block)
    shape = item.shape
    materials = sample_materials(shape.parts, rng)
    R_world_object = _vertical(rng.uniform(-np.pi, np.pi))
    flying = shape.category == "aeroplane" and rng.random() < config.flying_probability
    if flying:
        pitch, bank = np.radians(rng.normal(0, [8.0, 15.0]))
        cp, sp, cb, sb = np.cos(pitch), np.sin(pitch), np.cos(bank), np.sin(bank)
        R_pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        R_bank = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
        R_world_object = R_world_object @ R_pitch @ R_bank
    extents = shape.dimensions / shape.diagonal
    texture_seed = int(rng.integers(2**31))
    own = np.random.default_rng(texture_seed)  # of its own, so that the share changes nothing else in the scene
    if own.random() < config.single_material:
        materials = (sample_material("body", own),) * len(materials)
    place = composer.place(extents, R_world_object, _pixel_range(config.object_pixels, config.size), flying)
    if place is None:
        return None
    centre, diagonal = place
    R_camera_object = composer.R_camera_world @ R_world_object
    placed = MeshInstance(item.mesh, R_camera_object * diagonal, centre, materials, instance_id, texture_seed)
    return SceneObject(R_camera_object, centre, diagonal, item), placed


def _pixel_range(pixels: tuple[float, float], size: int) -> tuple[float, float]:
    """Least px and greatest share; the least never exceeds the greatest."""
    return min(pixels[0], pixels[1] * size), pixels[1]


_UNIT_MESHES: dict[str, Mesh] = {}


def _unit_mesh(kind: str) -> Mesh:
    if kind not in _UNIT_MESHES:
        vertices, faces = clutter.unit_mesh(kind)
        _UNIT_MESHES[kind] = Mesh(vertices, faces, np.zeros(len(faces), dtype=np.int64))
    return _UNIT_MESHES[kind]


def _distractors(composer: _Composer, config: SceneConfig, rng: np.random.Generator) -> list[MeshInstance]:
    """Draw one piece of clutter and its place."""
    parts, box = clutter.sample_distractors(rng)
    roles = rng.choice(["body", "wood", "metal", "fabric", "trim"], size=len(parts), p=[0.4, 0.2, 0.1, 0.2, 0.1])
    materials = [sample_material(str(role), rng) for role in roles]
    R_world_local = _vertical(rng.uniform(-np.pi, np.pi))
    flying = rng.random() < 0.1
    texture_seed = int(rng.integers(2**31))
    pixel_range = _pixel_range(config.clutter_pixels, config.size)
    place = composer.place(box[1] - box[0], R_world_local, pixel_range, flying)
    if place is None:
        return []
    centre, diagonal = place
    linear = composer.R_camera_world @ R_world_local * diagonal
    return [
        MeshInstance(_unit_mesh(p.kind), linear @ p.linear, linear @ p.offset + centre, (material,), -1, texture_seed)
        for p, material in zip(parts, materials)
    ]


def _occluder(composer: _Composer, config: SceneConfig, rng: np.random.Generator) -> list[MeshInstance]:
    """Draw a person or a plant and its place."""
    parts, roles, box = sample_occluder(rng)
    R_world_local = _vertical(rng.uniform(-np.pi, np.pi))
    texture_seed = int(rng.integers(2**31))
    place = composer.place(box[1] - box[0], R_world_local, _pixel_range(config.object_pixels, config.size), False)
    if place is None:
        return []
    centre, diagonal = place
    linear = composer.R_camera_world @ R_world_local * diagonal
    clothes: dict[str, Material] = {}
    placed = []
    for part, role in zip(parts, roles):
        material = clothes.setdefault(role, sample_material(role, rng)) if role != "fabric" else sample_material(role, rng)
        placed.append(
            MeshInstance(
                _unit_mesh(part.kind), linear @ part.linear, linear @ part.offset + centre, (material,), -1, texture_seed
            )
        )
    return placed


def sample_scene(
    config: SceneConfig,
    rng: np.random.Generator,
    pool: ShapeLibrary,
    photographs: BackgroundImages | None = None,
    block: int = 0,
) -> Scene:
    """Draw a scene. Everything random comes from `rng`; objects that find no room are left out.

    Args:
        config: what scenes look like.
        rng: source of every random number.
        pool: the shapes.
        photographs: pictures for the background, if any.
        block: which window of the pool's instances to draw from.
    """
    composer = _Composer(config, rng)
    objects: list[SceneObject] = []
    placed: list[MeshInstance] = []
    empty = rng.random() < config.empty_probability
    wanted = 0 if empty else int(rng.integers(config.objects[0], config.objects[1] + 1))
    for _ in range(wanted):
        found = _object(composer, pool, block, len(objects), config, rng)
        if found is not None:
            objects.append(found[0])
            placed.append(found[1])
    for _ in range(int(rng.integers(config.clutter[0], config.clutter[1] + 1))):
        placed.extend(_distractors(composer, config, rng))
    own = np.random.default_rng(rng.bit_generator.seed_seq.spawn(1)[0])  # type: ignore[attr-defined]
    for _ in range(int(own.integers(config.occluders + 1)) if config.occluders else 0):
        placed.extend(_occluder(composer, config, own))
    lights, ambient_sky, ambient_ground = sample_light(config, rng, composer.R_camera_world)
    backdrop = sample_environment(config, rng, composer.R_camera_world, photographs)
    if config.daylight and own.random() < config.daylight and backdrop.picture is None and backdrop.wall is None:
        lights, ambient_sky, ambient_ground = daylight(lights, backdrop, composer.up, own)
    angle = rng.uniform(-np.pi, np.pi)
    view = View(
        height=config.size,
        width=config.size,
        intrinsics=composer.intrinsics,
        up=composer.up,
        north=composer.R_camera_world @ np.array([np.cos(angle), np.sin(angle), 0.0]),
        camera_height=CAMERA_HEIGHT,
        placed=tuple(placed),
        lights=lights,
        ambient_sky=ambient_sky,
        ambient_ground=ambient_ground,
        backdrop=backdrop,
    )
    turn, length = own.uniform(-np.pi, np.pi), own.uniform(0, config.motion_blur) if config.motion_blur else 0.0
    return Scene(
        view=view,
        objects=tuple(objects),
        exposure=rng.uniform(*config.exposure),
        blur=rng.uniform(0, config.blur),
        noise=rng.uniform(0, config.noise),
        noise_seed=int(rng.integers(2**63)),
        supersample=config.supersample,
        least_visibility=config.least_visibility,
        least_box=config.least_box,
        motion=(length * np.cos(turn), length * np.sin(turn)),
        vignetting=own.uniform(0, config.vignetting) if config.vignetting else 0.0,
        jpeg_quality=int(own.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1)),
    )


def scene_at(
    config: SceneConfig, seed: int, index: int, pool: ShapeLibrary, photographs: BackgroundImages | None = None
) -> Scene:
    """Scene `index` of seed `seed`: depends on nothing else, however many processes share the work."""
    return sample_scene(config, np.random.default_rng([seed, index]), pool, photographs, index // BLOCK)
