"""Compiled shading: what each pixel shows and how much light it sends. NumPy took three times as long.

Arrays are flat over rays, which go through `slopes` (x / z and y / z), and single precision. `kind` is the material
number of a ray that meets a mesh, else `GROUND`, `WALL` or `SKY`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from nolbo_ppl.synthetic.renderer.textures import SOLID, noise_at, plane_pattern, surface_pattern, wood_at

GROUND = -1
WALL = -2
SKY = -3

HAZE = 60.0
"""Distance, in camera heights, at which the ground has faded into the horizon."""


@numba.njit(cache=True)
def _plane_albedo(
    surface: tuple, point: np.ndarray, normal: np.ndarray, along: np.ndarray, focal: float, albedo: np.ndarray
) -> None:
    """Albedo of a plane's texture at a point; the pattern fades where a pixel covers more than a period."""
    colours, pattern, frequency, seed = surface
    across_x = normal[1] * along[2] - normal[2] * along[1]
    across_y = normal[2] * along[0] - normal[0] * along[2]
    across_z = normal[0] * along[1] - normal[1] * along[0]
    u = point[0] * along[0] + point[1] * along[1] + point[2] * along[2]
    v = point[0] * across_x + point[1] * across_y + point[2] * across_z
    span2 = point[0] ** 2 + point[1] ** 2 + point[2] ** 2
    drop = abs(point[0] * normal[0] + point[1] * normal[1] + point[2] * normal[2])
    footprint = span2 / (focal * max(drop, 1e-3 * math.sqrt(span2)))
    fade = 1.0 / (1.0 + (2.0 * frequency * footprint) ** 2)
    mix = 0.5 + (plane_pattern(pattern, u * frequency, v * frequency, seed) - 0.5) * fade
    for c in range(3):
        albedo[c] = colours[0, c] + mix * (colours[1, c] - colours[0, c])


@numba.njit(cache=True)
def surfaces(
    slopes: np.ndarray,
    focal: np.float32,
    index: np.ndarray,
    face: np.ndarray,
    depth: np.ndarray,
    inverse: np.ndarray,
    offset: np.ndarray,
    first_face: np.ndarray,
    face_normals: np.ndarray,
    face_part: np.ndarray,
    first_material: np.ndarray,
    texture_seed: np.ndarray,
    material_albedo: np.ndarray,
    material_pattern: np.ndarray,
    material_contrast: np.ndarray,
    material_frequency: np.ndarray,
    up: np.ndarray,
    camera_height: np.float32,
    north: np.ndarray,
    ground: tuple,
    has_wall: bool,
    wall_normal: np.ndarray,
    wall_distance: np.float32,
    wall: tuple,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Point, normal towards the camera, albedo and kind of what each pixel shows."""
    n = len(index)
    points = np.zeros((n, 3), dtype=np.float32)
    normals = np.zeros((n, 3), dtype=np.float32)
    albedo = np.zeros((n, 3), dtype=np.float32)
    kind = np.empty(n, dtype=np.int32)
    for i in range(n):
        x, y = slopes[i, 0], slopes[i, 1]
        k = index[i]
        if k >= 0:
            z = depth[i]
            points[i, 0], points[i, 1], points[i, 2] = x * z, y * z, z
            f = first_face[k] + face[i]
            m = first_material[k] + face_part[f]
            kind[i] = m
            # Normals transform by the inverse transpose.
            for c in range(3):
                for d in range(3):
                    normals[i, c] += face_normals[f, d] * inverse[k, d, c]
            length = math.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
            towards = normals[i, 0] * x + normals[i, 1] * y + normals[i, 2]
            factor = (-1.0 if towards > 0 else 1.0) / max(length, 1e-20)
            for c in range(3):
                normals[i, c] *= factor
            texture = 1.0
            if material_pattern[m] > 0:
                q = np.zeros(3, dtype=np.float32)
                for c in range(3):
                    for d in range(3):
                        q[c] += inverse[k, c, d] * (points[i, d] - offset[k, d])
                    q[c] *= material_frequency[m]
                if material_pattern[m] >= SOLID:
                    # Laid out on the face itself, and faded where a pixel covers more than its detail.
                    range2 = points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2
                    cosine = abs(towards) / (max(length, 1e-20) * math.sqrt(x * x + y * y + 1))
                    pixel = math.sqrt(range2 / max(cosine, 0.02)) / focal * material_frequency[m]
                    value = surface_pattern(int(material_pattern[m]), q, face_normals[f], texture_seed[k], pixel)
                elif material_pattern[m] == 1:
                    value = float(noise_at(q[0], q[1], q[2], texture_seed[k], 1, True))
                elif material_pattern[m] == 2:
                    value = wood_at(q[0], q[1], q[2], texture_seed[k])
                else:
                    value = 1.0 if q[2] - math.floor(q[2]) < 0.5 else 0.0
                texture = 1.0 + material_contrast[m] * (2.0 * value - 1.0)
            for c in range(3):
                albedo[i, c] = material_albedo[m, c] * texture
            continue
        kind[i] = SKY
        drop = -(x * up[0] + y * up[1] + up[2])
        distance = camera_height / drop if drop > 1e-4 else np.inf
        if has_wall:
            reach = x * wall_normal[0] + y * wall_normal[1] + wall_normal[2]
            if reach > 1e-4 and wall_distance / reach < distance:
                z = wall_distance / reach
                points[i, 0], points[i, 1], points[i, 2] = x * z, y * z, z
                normals[i] = -wall_normal
                kind[i] = WALL
                _plane_albedo(wall, points[i], normals[i], up, focal, albedo[i])  # type: ignore[arg-type]
                continue
        if distance < np.inf:
            points[i, 0], points[i, 1], points[i, 2] = x * distance, y * distance, distance
            normals[i] = up
            kind[i] = GROUND
            _plane_albedo(ground, points[i], up, north, focal, albedo[i])  # type: ignore[arg-type]
    return points, normals, albedo, kind


@numba.njit(cache=True)
def facing_points(points: np.ndarray, normals: np.ndarray, kind: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of meshes and ground that face the light, and their points lifted off the surface."""
    chosen = np.empty(len(points), dtype=np.int64)
    lifted = np.empty((len(points), 3), dtype=np.float32)
    count = 0
    for i in range(len(points)):
        cosine = normals[i, 0] * light[0] + normals[i, 1] * light[1] + normals[i, 2] * light[2]
        if kind[i] >= GROUND and cosine > 0:
            lift = np.float32(2e-3) * points[i, 2] + np.float32(1e-5)
            chosen[count] = i
            for c in range(3):
                lifted[count, c] = points[i, c] + lift * normals[i, c]
            count += 1
    return chosen[:count], lifted[:count]


@numba.njit(cache=True)
def behind_ball(
    points: np.ndarray, dark: np.ndarray, centre: np.ndarray, radius: np.float32, light: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the points, not dark yet, whose ray to the light may meet a ball; their offsets from its centre."""
    chosen = np.empty(len(points), dtype=np.int64)
    offset = np.empty((len(points), 3), dtype=np.float32)
    count = 0
    for i in range(len(points)):
        if dark[i]:
            continue
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        along = -(x * light[0] + y * light[1] + z * light[2])
        if along > -radius and x * x + y * y + z * z - along * along < radius * radius:
            chosen[count] = i
            offset[count, 0], offset[count, 1], offset[count, 2] = x, y, z
            count += 1
    return chosen[:count], offset[:count]


@numba.njit(cache=True)
def _sky(height: float, zenith: np.ndarray, horizon: np.ndarray, c: int) -> float:
    """One channel of the sky at a given sine of elevation; below the horizon that of the horizon."""
    mix = math.sqrt(min(max(1.6 * height, 0.0), 1.0))
    return horizon[c] + mix * (zenith[c] - horizon[c])


@numba.njit(cache=True)
def illuminate(
    slopes: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    albedo: np.ndarray,
    kind: np.ndarray,
    lit: np.ndarray,
    light_direction: np.ndarray,
    light_colour: np.ndarray,
    up: np.ndarray,
    ambient_sky: np.ndarray,
    ambient_ground: np.ndarray,
    zenith: np.ndarray,
    horizon: np.ndarray,
    specular: np.ndarray,
    shininess: np.ndarray,
    mirror: np.ndarray,
    glow: np.ndarray,
    camera_height: np.float32,
    clouds: np.float32,
    cloud_seed: int,
    sky: np.ndarray,
    mesh_haze: np.float32,
    has_picture: bool,
    picture: np.ndarray,
) -> np.ndarray:
    """Linear RGB of each pixel: hemisphere ambient, Lambert, Blinn-Phong, a mirrored sky; pictures take shadow only."""
    n = len(points)
    colour = np.empty((n, 3), dtype=np.float32)
    diffuse = np.empty(3, dtype=np.float32)
    full = np.empty(3, dtype=np.float32)
    for i in range(n):
        x, y = slopes[i, 0], slopes[i, 1]
        length = math.sqrt(x * x + y * y + 1)
        ex, ey, ez = -x / length, -y / length, -1 / length
        if kind[i] == SKY:
            if has_picture:
                colour[i] = picture[i]
                continue
            height = -(ex * up[0] + ey * up[1] + ez * up[2])
            cloud = 1.0
            if clouds > 0:
                sx = -4 * (sky[0, 0] * ex + sky[0, 1] * ey + sky[0, 2] * ez)
                sy = -4 * (sky[1, 0] * ex + sky[1, 1] * ey + sky[1, 2] * ez)
                sz = -4 * (sky[2, 0] * ex + sky[2, 1] * ey + sky[2, 2] * ez)
                cloud += float(clouds * (noise_at(sx, sy, sz, cloud_seed, 3, True) - 0.5))
            for c in range(3):
                colour[i, c] = _sky(height, zenith, horizon, c) * cloud
            continue
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        lift = 0.5 + 0.5 * (nx * up[0] + ny * up[1] + nz * up[2])
        shine = np.zeros(3, dtype=np.float32)
        for c in range(3):
            diffuse[c] = ambient_ground[c] + lift * (ambient_sky[c] - ambient_ground[c])
            full[c] = diffuse[c]
        for j in range(len(light_direction)):
            lx, ly, lz = light_direction[j, 0], light_direction[j, 1], light_direction[j, 2]
            cosine = max(nx * lx + ny * ly + nz * lz, 0.0)
            for c in range(3):
                full[c] += light_colour[j, c] * cosine
            if not lit[j, i] or cosine <= 0:
                continue
            for c in range(3):
                diffuse[c] += light_colour[j, c] * cosine
            if kind[i] >= 0:
                hx, hy, hz = lx + ex, ly + ey, lz + ez
                norm = math.sqrt(hx * hx + hy * hy + hz * hz)
                half = max((nx * hx + ny * hy + nz * hz) / max(norm, 1e-12), 0.0)
                highlight = specular[kind[i]] * half ** shininess[kind[i]]
                for c in range(3):
                    shine[c] += light_colour[j, c] * highlight
        if kind[i] >= 0:
            m = kind[i]
            facing = nx * ex + ny * ey + nz * ez
            strength = 0.0
            if mirror[m] > 0:
                strength = mirror[m] + (1 - mirror[m]) * 0.6 * (1 - facing) ** 5
            rx, ry, rz = 2 * facing * nx - ex, 2 * facing * ny - ey, 2 * facing * nz - ez
            height = rx * up[0] + ry * up[1] + rz * up[2]
            for c in range(3):
                value = albedo[i, c] * (diffuse[c] + glow[m]) + shine[c]
                seen = _sky(height, zenith, horizon, c) if height >= 0 else 0.8 * ambient_ground[c]
                colour[i, c] = value + strength * (seen - value)
            if mesh_haze > 0:
                fog = 1 - math.exp(-((mesh_haze * points[i, 2]) ** 2))
                for c in range(3):
                    colour[i, c] += fog * (horizon[c] - colour[i, c])
        elif has_picture:
            for c in range(3):
                colour[i, c] = picture[i, c] * diffuse[c] / max(full[c], 1e-6)
        else:
            haze = 0.0
            if kind[i] == GROUND:
                haze = min(points[i, 2] / (camera_height * HAZE), 1.0) ** 2
            for c in range(3):
                value = albedo[i, c] * diffuse[c]
                colour[i, c] = value + haze * (horizon[c] - value)
    return colour
