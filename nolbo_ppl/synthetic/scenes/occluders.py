"""People and plants, made of balls, cylinders and cones: what stands before objects in photographs, and is none of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from nolbo_ppl.synthetic.scenes.distractors import DistractorPart, unit_mesh

SKIN = ("#f1c9a5", "#e0ac85", "#c68863", "#a16b46", "#7a4a2e", "#4b2c1c")
HAIR = ("#1a1410", "#3a2618", "#6b4a2a", "#a88a5a", "#777777")
LEAVES = ("#2f5d2a", "#44772f", "#5f8f3b", "#24481f", "#7d8f3a")


def _between(start: np.ndarray, end: np.ndarray, width: float, kind: str = "cylinder") -> DistractorPart:
    """A limb from one point to another."""
    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length
    helper = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    R = np.stack((x, np.cross(z, x), z), axis=1)
    return DistractorPart(kind, R * np.array([width, width, length]), (start + end) / 2)


def _ball(centre: np.ndarray, size: np.ndarray) -> DistractorPart:
    return DistractorPart("ball", np.diag(size), centre)


def sample_person(rng: np.random.Generator) -> tuple[list[DistractorPart], list[str]]:
    """Parts of a person who stands, walks or reaches out, about 1.7 high, and the role of each part's material."""
    skin, hair = f"colour {rng.choice(SKIN)}", f"colour {rng.choice(HAIR)}"
    parts, roles = [], []

    def add(part: DistractorPart, role: str) -> None:
        parts.append(part)
        roles.append(role)

    broad = rng.uniform(0.85, 1.25)
    hip, shoulder = np.array([0.0, 0.0, 0.9]), np.array([0.0, rng.uniform(-0.08, 0.05), 1.42])
    stride = rng.uniform(-0.35, 0.35) if rng.random() < 0.6 else 0.0
    for side, swing in ((-1, stride), (1, -stride)):
        root = hip + np.array([0.1 * side * broad, 0.0, 0.0])
        knee = np.array([root[0], -0.6 * swing, 0.48])
        foot = np.array([root[0], swing, 0.06])
        add(_between(root, knee, 0.17 * broad), "fabric")
        add(_between(knee, foot, 0.13 * broad), "fabric" if rng.random() < 0.85 else skin)
        add(_ball(foot + np.array([0.0, -0.07, -0.02]), np.array([0.1, 0.26, 0.09])), "trim")
        arm = shoulder + np.array([0.22 * side * broad, 0.0, -0.03])
        reach = rng.uniform(0.0, 1.6) if rng.random() < 0.3 else rng.uniform(0.0, 0.4)
        elbow = arm + 0.28 * np.array([0.25 * side, -np.sin(reach), -np.cos(reach)])
        bend = reach + rng.uniform(0.0, 1.2)
        hand = elbow + 0.26 * np.array([0.0, -np.sin(bend), -np.cos(bend)])
        add(_between(arm, elbow, 0.1 * broad), "fabric")
        add(_between(elbow, hand, 0.08 * broad), "fabric" if rng.random() < 0.5 else skin)
        add(_ball(hand, np.array([0.09, 0.09, 0.11])), skin)
    add(_ball((hip + shoulder) / 2 + np.array([0, 0, 0.02]), np.array([0.42 * broad, 0.26 * broad, 0.72])), "fabric")
    head = shoulder + np.array([0.0, -0.02, 0.25])
    add(_between(shoulder, head, 0.12), skin)
    add(_ball(head, np.array([0.17, 0.2, 0.24])), skin)
    add(_ball(head + np.array([0.0, 0.025, 0.035]), np.array([0.185, 0.19, 0.22])), hair)
    return parts, roles


def sample_plant(rng: np.random.Generator) -> tuple[list[DistractorPart], list[str]]:
    """Parts of a shrub, a tree or a plant in a pot, about 1 high, and the role of each part's material."""
    leaf = [f"colour {rng.choice(LEAVES)}" for _ in range(3)]
    parts, roles = [], []
    low = 0.0
    if rng.random() < 0.4:
        low = rng.uniform(0.15, 0.3)
        parts.append(DistractorPart("cylinder", np.diag([0.3, 0.3, low]), np.array([0.0, 0.0, low / 2])))
        roles.append("body")
    crown = rng.uniform(low + 0.05, 0.75)
    if rng.random() < 0.25:  # a conifer
        parts.append(DistractorPart("cylinder", np.diag([0.07, 0.07, 0.3]), np.array([0.0, 0.0, low + 0.15])))
        roles.append("wood")
        for k in range(3):
            size = 0.6 - 0.15 * k
            parts.append(DistractorPart("cone", np.diag([size, size, 0.4]), np.array([0.0, 0.0, low + 0.35 + 0.22 * k])))
            roles.append(leaf[k])
        return parts, roles
    parts.append(_between(np.array([0.0, 0.0, low]), np.array([0.0, 0.0, crown + 0.1]), rng.uniform(0.02, 0.08)))
    roles.append("wood")
    for _ in range(int(rng.integers(14, 34))):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        centre = np.array([0.0, 0.0, (crown + 1.0) / 2]) + direction * rng.uniform(0.3, 1.0) * np.array(
            [0.3, 0.3, (1.0 - crown) / 2]
        )
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        parts.append(DistractorPart("ball", turn * rng.uniform(0.08, 0.24) * np.array([1.0, 0.6, 0.2]), centre))
        roles.append(leaf[int(rng.integers(3))])
    return parts, roles


def sample_occluder(rng: np.random.Generator) -> tuple[list[DistractorPart], list[str], Float[np.ndarray, "2 3"]]:
    """A person or a plant, its parts' roles, and its box; scaled to a box diagonal of 1 and centred, as `sample_distractors`."""
    parts, roles = sample_person(rng) if rng.random() < 0.6 else sample_plant(rng)
    corners = np.concatenate([unit_mesh(p.kind)[0] @ p.linear.T + p.offset for p in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale, centre = 1.0 / float(np.linalg.norm(high - low)), 0.5 * (low + high)
    placed = [DistractorPart(p.kind, p.linear * scale, (p.offset - centre) * scale) for p in parts]
    return placed, roles, np.stack((low - centre, high - centre)) * scale
