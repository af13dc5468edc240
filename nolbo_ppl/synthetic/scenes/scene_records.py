"""The line of `scenes.jsonl` of a rendered scene; `nolbo_ppl.io.scenes` reads it back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from nolbo_ppl.geometry.rotation import matrix_to_quaternion
from nolbo_ppl.synthetic.scenes.render_scene import Rendered


def record_of(rendered: Rendered, image: str) -> dict[str, Any]:
    """The line of a rendered scene, rounded to 1e-6 (px, m) and quaternions to 1e-9."""
    objects = []
    for label in rendered.labels:
        quaternion = matrix_to_quaternion(torch.from_numpy(np.asarray(label.R_camera_object, dtype=np.float64)))
        objects.append(
            {
                "category": label.category,
                "instance": label.instance,
                "box": [round(float(v), 6) for v in label.box],
                "rotation": [round(v, 9) for v in quaternion.tolist()],
                "position": [round(float(v), 6) for v in label.position],
                "size": round(float(label.size), 6),
                "dimensions": [round(float(v), 6) for v in label.dimensions],
                "visibility": round(float(label.visibility), 6),
                "symmetry": int(label.symmetry),
            }
        )
    return {"image": image, "intrinsics": [round(float(v), 6) for v in rendered.intrinsics], "objects": objects}
