"""Cameras in YAML and JSON as calibration tools write them: OpenCV, ROS, Kalibr, EuRoC, ORB-SLAM, VINS, OpenVSLAM.

Each layout becomes the same flat fields: fx, fy, cx, cy, width, height, the distortion and its model.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from nolbo_ppl.errors import input_error
from nolbo_ppl.geometry.distortion import COUNTS, DistortionModel

FORMATS = (
    "YAML of OpenCV, ROS, Kalibr, EuRoC or ORB-SLAM; JSON with fx, fy, cx, cy; a KITTI calibration; or the numbers fx fy cx cy"
)
"""What is read, for messages."""
MODELS: dict[str, DistortionModel | None] = {
    "": None,
    "none": None,
    "pinhole": None,
    "perspective": None,
    "rectified": None,
    "plumb_bob": "radial-tangential",
    "radtan": "radial-tangential",
    "radial-tangential": "radial-tangential",
    "radial_tangential": "radial-tangential",
    "brown": "radial-tangential",
    "brown_conrady": "radial-tangential",
    "opencv": "radial-tangential",
    "rational": "rational",
    "rational_polynomial": "rational",
    "full_opencv": "rational",
    "thin_prism": "rational",
    "fisheye": "fisheye",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "kannalabrandt8": "fisheye",
    "kannala_brandt": "fisheye",
    "kannalabrandt": "fisheye",
    "opencv_fisheye": "fisheye",
}
"""Names of distortion models, in lower case, and what they are here; None says nothing about a distortion."""
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
CAMERA = ("fx", "fy", "cx", "cy")
_SILENT = re.compile(
    r"_.*|name|camera_name|camera|comment|note|description|source|serial.*|frame_id|header|depth_.*|fps|units?|version|date"
)
"""Fields of a JSON file that say nothing about the geometry."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Safe YAML that takes OpenCV's matrices as what they hold."""


def _tagged(loader: yaml.SafeLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else loader.construct_scalar(node)


for _name in ("opencv-matrix", "opencv-nd-matrix", "opencv-sparse-matrix"):
    _Loader.add_multi_constructor(f"tag:yaml.org,2002:{_name}", _tagged)


def load_yaml(path: Path, lines: Sequence[str]) -> Any:
    """One YAML document. OpenCV's first line `%YAML:1.0` is not YAML's. Raises `InputError` naming file and line."""
    text = "\n".join("" if line.startswith("%") else line for line in lines)
    if len(text) > 1 << 20:
        raise input_error("YAML file too large for a camera", got=f"{len(text)} characters", expected="at most 1 MB", file=path)
    if re.search(r"(^|[\s\[{,:-])[&*][A-Za-z_]", text, re.MULTILINE):
        raise input_error("YAML with anchors", expected="plain values", file=path)  # a few lines of them unfold to gigabytes
    try:
        return yaml.load(text, Loader=_Loader)  # a SafeLoader
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else None
        raise input_error("not valid YAML", got=error.problem, file=path, line=line) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise input_error("not valid YAML", got=str(error)[:80], file=path) from None


def _flat(value: Any) -> list[Any]:
    """Numbers of a matrix, however it is nested."""
    if isinstance(value, Mapping):
        value = value.get("data", list(value.values()))
    if not isinstance(value, list | tuple):
        return [value]
    return [item for part in value for item in _flat(part)]


def _from_matrix(value: Any, path: Path) -> dict[str, Any]:
    m = _flat(value)
    if len(m) == 12:
        m = [*m[:3], *m[4:7], *m[8:11]]
    good = len(m) == 9 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in m)
    if not good or [m[3], m[6], m[7]] != [0, 0, 0] or m[8] != 1:
        raise input_error("camera matrix", got=str(m)[:80], expected="fx 0 cx, 0 fy cy, 0 0 1", file=path)
    if abs(m[1]) > 1e-6 * abs(m[0]):
        raise input_error("camera matrix with skew", got=m[1], expected="0: pixels at right angles", file=path)
    return {"fx": m[0], "fy": m[4], "cx": m[2], "cy": m[5]}


def _first(content: Mapping[str, Any], *names: str) -> Any:
    """Value of the first of these keys that is there, in any case."""
    lower = {str(key).lower(): value for key, value in content.items()}
    return next((lower[name] for name in names if name in lower), None)


def _dotted(content: Mapping[str, Any]) -> dict[str, Any] | None:
    """ORB-SLAM's `Camera.fx`, `Camera1.fx`, OpenVSLAM's nested `Camera: {fx}` as plain fields; None for other layouts."""
    nested = _first(content, "camera", "camera1")
    if isinstance(nested, Mapping):
        return {str(key).lower(): value for key, value in nested.items()}
    for prefix in ("camera1.", "camera."):
        found = {str(key)[len(prefix) :].lower(): value for key, value in content.items() if str(key).lower().startswith(prefix)}
        if "fx" in found:
            shared = {str(key)[7:].lower(): value for key, value in content.items() if str(key).lower().startswith("camera.")}
            return shared | found
    return None


def fields_of(content: Any, path: Path) -> dict[str, Any]:
    """Flat fields of a document: fx, fy, cx, cy, width, height, `distortion` (a list), `model` (a name).

    Raises:
        InputError: none of the known layouts.
    """
    if not isinstance(content, Mapping):
        raise input_error("not a camera", got=type(content).__name__, expected=FORMATS, file=path)
    if isinstance(_first(content, "cam0"), Mapping):
        content = _first(content, "cam0")  # Kalibr: the first camera of a chain
    out: dict[str, Any] = {}
    dotted = _dotted(content)
    if dotted is not None:
        out = {name: dotted.get(name) for name in CAMERA}
        out |= {"width": _first(dotted, "width", "cols"), "height": _first(dotted, "height", "rows")}
        out["coefficients"] = {k: v for k, v in dotted.items() if re.fullmatch(r"[kp]\d", k)}
        out["model"] = _first(content, "camera.type", "camera.model") or _first(dotted, "type", "model")
        return out
    projection = _first(content, "projection_parameters")
    if isinstance(projection, Mapping):  # VINS
        kind = str(_first(content, "model_type") or "pinhole").lower()
        if kind == "kannala_brandt":
            out = dict(zip(CAMERA, (projection.get(name) for name in ("mu", "mv", "u0", "v0"))))
            out["distortion"] = [projection.get(name) for name in ("k2", "k3", "k4", "k5")]
        else:
            out = {name: projection.get(name) for name in CAMERA}
            out["coefficients"] = dict(_first(content, "distortion_parameters") or {})
        out["model"] = kind
    elif _first(content, "camera_matrix", "k", "cameramatrix", "intrinsic_matrix", "m1") is not None:
        out = _from_matrix(_first(content, "camera_matrix", "k", "cameramatrix", "intrinsic_matrix", "m1"), path)
    elif isinstance(_first(content, "intrinsics"), list):  # Kalibr, EuRoC
        values = _flat(_first(content, "intrinsics"))
        if len(values) != 4:
            raise input_error("`intrinsics`", got=f"{len(values)} numbers", expected="fx fy cx cy", file=path)
        out = dict(zip(CAMERA, values))
        kind = str(_first(content, "camera_model") or "pinhole").lower()
        if kind != "pinhole":
            raise input_error("camera model", got=kind, expected="pinhole", do="calibrate as a pinhole camera", file=path)
    elif _first(content, "fx") is not None or _first(content, "fl_x") is not None:
        out = {name: _first(content, name, {"fx": "fl_x", "fy": "fl_y"}.get(name, name)) for name in CAMERA}
        out["coefficients"] = {k: v for k, v in content.items() if re.fullmatch(r"[kp]\d", str(k))}
    else:
        raise input_error("no camera in the file", got=", ".join(map(str, list(content)[:8])), expected=FORMATS, file=path)
    size = _first(content, "resolution", "image_size")
    if isinstance(size, list) and len(size) == 2:
        out["width"], out["height"] = size
    else:
        out["width"] = _first(content, "width", "image_width", "w")
        out["height"] = _first(content, "height", "image_height", "h")
    given = _first(content, "distortion_coefficients", "distortion_coeffs", "distortion", "dist_coeffs", "dist_coeff", "d", "d1")
    if given is not None and not isinstance(given, str):
        out["distortion"] = _flat(given)
    kind = _first(content, "distortion_model", "distortion_type")
    if kind is None and "model" not in out:
        kind = _first(content, "camera_model", "model")
    out.setdefault("model", kind)
    if kind is not None:
        out["model"] = kind
    return out


def unknown_fields(content: Mapping[str, Any]) -> list[str]:
    """Fields of a JSON camera that are not understood."""
    known = {
        *CAMERA, *ORDER, "fl_x", "fl_y", "w", "h", "width", "height", "image_width", "image_height", "resolution", "image_size",
        "k", "camera_matrix", "cameramatrix", "intrinsic_matrix", "intrinsics", "d", "distortion", "distortion_coefficients",
        "distortion_coeffs", "dist_coeffs", "dist_coeff", "distortion_model", "distortion_type", "camera_model", "model",
        "cam0", "r", "p", "rectification_matrix", "projection_matrix", "roi", "binning_x", "binning_y", "rows", "cols",
    }  # fmt: skip
    return sorted(str(key) for key in content if str(key).lower() not in known and not _SILENT.fullmatch(str(key).lower()))


def distortion_of(fields: Mapping[str, Any], path: Path) -> tuple[DistortionModel | None, tuple[float, ...]]:
    """Model and coefficients; None and nothing where there is no distortion.

    Raises:
        InputError: an unknown model, a number of coefficients that is not the model's, or values that are no numbers.
    """
    name = str(fields.get("model") or "").lower()
    if name not in MODELS:
        raise input_error(
            "distortion model",
            got=name,
            expected="radial-tangential (plumb_bob, radtan), rational or fisheye (equidistant)",
            do="undistort the images first",
            file=path,
        )
    model = MODELS[name]
    values, named = list(fields.get("distortion") or []), dict(fields.get("coefficients") or {})
    if named and not values:
        order = ("k1", "k2", "k3", "k4") if model == "fisheye" else ORDER
        strange = sorted(set(named) - set(order))
        if strange:
            raise input_error("distortion", got=", ".join(strange), expected=", ".join(order), file=path)
        values = [named.get(key, 0.0) for key in order]
        if model != "fisheye":
            values = values[:5] if not any(named.get(key) for key in ORDER[5:]) else values
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6 for v in values):
        raise input_error("distortion", got=str(values)[:80], expected="finite numbers", file=path)
    if not any(values):
        return None, ()
    if model is None:
        model = next((kind for kind in ("radial-tangential", "rational") if len(values) in COUNTS[kind]), "radial-tangential")
    if model == "radial-tangential" and len(values) in COUNTS["rational"]:
        model = "rational"
    if len(values) == 5 and model == "rational":
        model = "radial-tangential"
    counts = COUNTS[model or "radial-tangential"]
    if len(values) not in counts:
        expected = " or ".join(map(str, counts))
        raise input_error(f"{model} distortion", got=f"{len(values)} numbers", expected=expected, file=path)
    return model, tuple(float(v) for v in values)
